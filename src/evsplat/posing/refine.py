"""Analysis by synthesis: a motion corrected so that discs on the body explain the pictures.

No Gaussians are trained. The person is drawn as one-coloured discs on the surface of the body, and
what is unknown of motion and look is moved downhill until the drawings are like the sharp pictures.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import Body, BodyTrack, PoseErrors
from evsplat.body.pose_noise import PoseNoise, joint_angles
from evsplat.camera import Camera
from evsplat.capture import TrainingCapture
from evsplat.errors import DataError
from evsplat.posing.correction import Correction
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import Targets, find_targets
from evsplat.posing.time_limit import TimeLimit

DISCS = 4_000
COARSE_PX = 64
"""Least side of the pictures that are compared first."""
UNKNOWN_RAD, UNKNOWN_M = 0.05, 0.02
"""Errors expected of limb joints and of the root's place, per axis, where nobody says."""
LEAST_GAIN = 0.12
"""Share by which pictures kept aside must be explained better, for certain, for given poses to
count as wrong. What discs cannot show of a person moves true motions: exact poses of staged people
were explained up to 0.08 better, fitted ones of a real recording 0.15."""
_LEAST_RAD, _LEAST_M = 0.006, 0.004
"""Errors that discs make of true motions, per axis: clothes, hair and hands are not the body's."""
_MISFIT = 0.06
"""Difference of coded colours from which on more of it counts little."""
_PIXEL_SHARE = 0.05
"""Independent values that a pixel's three colours count for: neighbours err alike."""
_COARSE_DISCS = 1_500
"""Discs drawn in the smallest pictures; twice as many in each next size, as far as there are."""
_STEPS = (160, 140)
_LAST_STEPS = 40
"""Steps in which pictures kept aside are explained as well, once they have judged."""
_NEARER = 0.6
"""How near to the corrected body the background is taken for sure, in shares of before."""
_LOOK_STEPS = 30
"""Steps in which the look alone is learned, at the start and where two motions are compared."""
_RATES = {"motion": 0.05, "colours": 0.03, "offsets": 0.1, "light": 0.01}
_PARTS = 3
"""Every so many-th picture is drawn in a step."""
_PROBES = 4
_PROBE_STEPS = 2 * _PARTS
"""Steps that each takes as long as."""


@dataclass(frozen=True)
class Stage:
    """One part of the descent."""

    pixels: int
    """Width of the pictures compared."""
    before: float
    after: float
    """Mean misfit of the pictures at its start and end, in units of one squared deviation."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A corrected motion, and whether it is better than the given one."""

    track: BodyTrack
    """The corrected motion with its errors; `better` says whether to use it."""
    gain: float
    """Share by which it explains pictures better that neither motion was fitted to."""
    gain_error: float
    """Standard error of the gain over the frames."""
    stages: tuple[Stage, ...]
    seconds: float

    @property
    def better(self) -> bool:
        """True where the gain exceeds 0 by two standard errors: these err less than given ones."""
        return self.gain - 2 * self.gain_error > 0

    @property
    def disproves(self) -> bool:
        """True where the given poses cannot be exact: the gain exceeds `LEAST_GAIN` as surely."""
        return self.gain - 2 * self.gain_error > LEAST_GAIN


def refine(
    track: BodyTrack,
    capture: TrainingCapture,
    *,
    seconds: float | None = None,
    progress: bool = False,
    steps: tuple[int, int] = _STEPS,
    discs: int = DISCS,
    seed: int = 0,
) -> Refined:
    """Correct a motion by the sharp pictures of a capture.

    Pictures in the middle of exposures are kept aside for the `gain`. Where the policy shows events
    of held-out frames, pictures carried there by events count as well. ``steps``: of the coarse
    and of the fine part, fewer where they would take more than ``seconds``.

    Raises:
        DataError: the camera moves, or the posed body is in no picture.
    """
    began = time.monotonic()
    planned = 3 * _LOOK_STEPS + sum(steps) + _LAST_STEPS + _PROBES * _PROBE_STEPS
    limit = TimeLimit(seconds, planned, progress=progress)
    targets = find_targets(track, capture)
    joint_rad, root_m = expected_errors(track)
    correction = Correction(track, joint_rad, root_m)
    look = SurfaceDiscs(track.body, discs, torch.Generator().manual_seed(seed))
    aside = _middles(targets)
    fitted = sorted(set(range(len(targets.times_us))) - set(aside)) or aside
    descent = _Descent(correction, look, targets.rows(fitted), limit)
    sizes = _sizes(targets.camera, steps)
    stages: list[Stage] = []
    for shrink, count in sizes:
        stages.append(descent.run(shrink, count, first=not stages))
        if len(stages) == 1:
            nearer = targets.around(correction.corrected(), _NEARER)
            descent.targets = nearer.rows(fitted)
    gain, gain_error = _gain(descent, targets.rows(aside))
    descent.targets = nearer
    stages.append(descent.run(1, _LAST_STEPS, first=False))
    errors = descent.errors()
    limit.close()
    return Refined(
        correction.corrected(errors), gain, gain_error, tuple(stages), time.monotonic() - began
    )


def _sizes(camera: Camera, steps: tuple[int, int]) -> list[tuple[int, int]]:
    """By how much pictures are made smaller, and steps at each size: fewer in larger ones."""
    shrink = 1
    while min(camera.width, camera.height) >= 2 * shrink * COARSE_PX:
        shrink *= 2
    finer = [1 << k for k in reversed(range(shrink.bit_length() - 1))] or [1]
    share = steps[1] / sum(finer)
    return [(shrink, steps[0]), *((size, max(1, round(share * size))) for size in finer)]


def expected_errors(track: BodyTrack) -> tuple[Float[np.ndarray, "J"], Float[np.ndarray, "3"]]:
    """What joints (radians) and root (metres) are expected to err by, per axis, root mean square.

    Where the track does not say, limbs by more than the trunk.
    """
    errors = track.errors
    if errors is not None and not errors.typical and errors.joint_rad.any():
        size = np.sqrt(np.square(errors.joint_rad).mean(0))
        return size, np.sqrt(np.square(errors.root_m).mean(0))
    return _anatomical(track.body), np.full(3, UNKNOWN_M)


def _anatomical(body: Body) -> Float[np.ndarray, "J"]:
    noise = PoseNoise(UNKNOWN_RAD, UNKNOWN_RAD / 2, UNKNOWN_M, UNKNOWN_M)
    try:
        return joint_angles(body, noise)
    except DataError:  # a skeleton without names
        return np.full(len(body.parents), UNKNOWN_RAD)


class _Descent:
    """Motion and look, moved downhill together."""

    def __init__(
        self,
        correction: Correction,
        look: SurfaceDiscs,
        targets: Targets,
        limit: TimeLimit | None = None,
    ) -> None:
        self.correction, self.look, self.targets = correction, look, targets
        self.limit = limit or TimeLimit(None, 1)
        self.discs = 0

    def run(self, shrink: int, steps: int, *, first: bool) -> Stage:
        """Adam on pictures smaller by a factor."""
        targets = self.targets.smaller(shrink) if shrink > 1 else self.targets
        known, self.discs = self.discs, self._discs(targets.camera)
        if self.discs > known:
            shown = targets.rows(torch.nonzero(targets.coloured)[:, 0].tolist())
            with torch.no_grad():
                motion = self.correction.at(shown.times_us)
            camera, image = shown.camera, shown.image
            self.look.colour_from(*motion, camera, image, first=known, count=self.discs)
        if first:
            self.learn_look(targets, shrink, _LOOK_STEPS)
        before = self.misfit(targets)
        motion = [self.correction.turns, self.correction.shifts]
        groups = [*self._look_groups(), {"params": motion, "rate": _RATES["motion"]}]
        self._descend(groups, targets, shrink, steps)
        return Stage(targets.camera.width, before, self.misfit(targets))

    def _discs(self, camera: Camera) -> int:
        """How many are drawn."""
        finer = max(1.0, min(camera.width, camera.height) / COARSE_PX)
        return min(len(self.look.colours), round(_COARSE_DISCS * finer))

    def learn_look(self, targets: Targets, shrink: int, steps: int) -> None:
        """Leave the motion as it is."""
        self._descend(self._look_groups(), targets, shrink, steps)

    def _look_groups(self) -> list[dict[str, Any]]:
        look = self.look
        shape = [look.offsets, look.bone_offsets, look.inset, look.layer]
        return [
            {"params": [look.colours], "rate": _RATES["colours"]},
            {"params": shape, "rate": _RATES["offsets"]},
            {"params": [look.light], "rate": _RATES["light"]},
        ]

    def _descend(
        self, groups: list[dict[str, Any]], targets: Targets, shrink: int, steps: int
    ) -> None:
        adam = torch.optim.Adam([{**g, "lr": g["rate"]} for g in groups], betas=(0.9, 0.98))
        count = len(targets.times_us)
        parts = [targets.rows(range(part, count, _PARTS)) for part in range(min(_PARTS, count))]
        for step, place in enumerate(self.limit.steps(steps)):
            for group in adam.param_groups:
                group["lr"] = group["rate"] * min(1.0, 2 * (1 - place) + 0.02)
            part = parts[step % len(parts)]
            loss = self._data(part) * (shrink**2 * count / len(part.times_us))
            loss = loss + self.correction.price() + self.look.price()
            adam.zero_grad()
            loss.backward()
            adam.step()
            with torch.no_grad():
                self.look.colours.clamp_(0, 1)

    def _data(self, targets: Targets) -> Float[Tensor, ""]:
        """Minus the logarithm of the likelihood: Cauchy-distributed differences."""
        return _PIXEL_SHARE * self._differences(targets).sum()

    def _differences(self, targets: Targets) -> Float[Tensor, "P"]:
        rotations, transl = self.correction.at(targets.times_us)
        drawn = self.look.draw(rotations, transl, targets.camera, targets.behind, self.discs)
        square = (targets.as_seen(drawn) - targets.image).square().sum(-1) / _MISFIT**2
        return (torch.log1p(square / 2) * targets.weight).sum((1, 2))

    @torch.no_grad()
    def misfits(self, targets: Targets) -> Float[Tensor, "P"]:
        """Mean per picture."""
        return self._differences(targets) / targets.weight.sum((1, 2)).clamp_min(1e-6)

    def misfit(self, targets: Targets) -> float:
        """Mean over all pictures."""
        return float(self.misfits(targets).mean())

    def errors(self) -> PoseErrors:
        """What is still unknown of the motion, by the curvature at the end (Laplace).

        The diagonal of the curvature from differences of gradients along random signs
        (Bekas et al., An estimator for the diagonal of a matrix, 2007).
        """
        correction = self.correction
        generator = torch.Generator().manual_seed(0)
        params = [correction.turns, correction.shifts]
        total = [torch.zeros_like(p) for p in params]
        probes = 0
        for _ in self.limit.steps(_PROBES, _PROBE_STEPS):
            probes += 1
            signs = [torch.randint(0, 2, p.shape, generator=generator) * 2.0 - 1 for p in params]
            up, down = (self._gradient(params, signs, size) for size in (0.05, -0.05))
            for one, a, b, sign in zip(total, up, down, signs, strict=True):
                one += sign * (a - b) / 0.1
        # What pictures say of a coordinate goes with its share of the variance.
        shares = correction.mixing.square().mean(0)
        rates = [one.mean(0).clamp_min(0) / probes / shares.mean() for one in total]
        times = correction.key_times.tolist()
        weights = correction.weights(times).square()
        known = [1 / (1 + torch.einsum("m,...->m...", shares, rate)) for rate in rates]
        joint = correction.joint_rad.square() * torch.einsum("tm,mjc->tj", weights, known[0]) / 3
        root = correction.root_m.square() * (weights @ known[1])
        joint = torch.minimum(joint + _LEAST_RAD**2, correction.joint_rad.square()).sqrt()
        root = torch.minimum(root + _LEAST_M**2, correction.root_m.square()).sqrt()
        joint_rad = np.zeros((len(times), len(correction.track.body.parents)))
        joint_rad[:, correction.joints.numpy()] = joint.detach().numpy()
        return PoseErrors("estimated", joint_rad, root.detach().double().numpy())

    def _gradient(
        self, params: Sequence[Tensor], signs: Sequence[Tensor], size: float
    ) -> list[Tensor]:
        with torch.no_grad():
            for param, sign in zip(params, signs, strict=True):
                param += size * sign
        found = torch.autograd.grad(self._data(self.targets), params)
        with torch.no_grad():
            for param, sign in zip(params, signs, strict=True):
                param -= size * sign
        return list(found)


def _middles(targets: Targets) -> list[int]:
    """Pictures of training frames that are nearest to the middle of each one's exposure."""
    best: dict[str, tuple[int, int]] = {}
    for number, (at, frame) in enumerate(zip(targets.times_us, targets.frames, strict=True)):
        if frame.split == "train":
            best[frame.name] = min(
                best.get(frame.name, (1 << 62, 0)), (abs(at - frame.mid_us), number)
            )
    return [number for _, number in best.values()]


def _gain(descent: _Descent, aside: Targets) -> tuple[float, float]:
    """How much better the corrected motion explains pictures kept aside, and the standard error.

    Both motions get their look learned for as many steps from where the corrected one's was.
    """
    params = [descent.correction.turns, descent.correction.shifts]
    found = [param.detach().clone() for param in params]
    state = {name: value.clone() for name, value in descent.look.state_dict().items()}
    misfits = []
    for factor in (1.0, 0.0):
        with torch.no_grad():
            for param, value in zip(params, found, strict=True):
                param.copy_(factor * value)
        descent.look.load_state_dict(state)
        descent.learn_look(descent.targets, 1, _LOOK_STEPS)
        misfits.append(descent.misfits(aside))
    with torch.no_grad():
        for param, value in zip(params, found, strict=True):
            param.copy_(value)
    descent.look.load_state_dict(state)
    better = (misfits[1] / misfits[0]).log()
    spread = float(better.std()) if len(better) > 1 else math.inf
    return 1 - math.exp(-float(better.mean())), spread / math.sqrt(len(better))
