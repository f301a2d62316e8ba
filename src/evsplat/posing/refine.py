"""Analysis by synthesis: a motion corrected so that discs on the body explain the pictures.

No Gaussians are trained. The person is drawn as one-coloured discs on the surface of the body, and
what is unknown of motion and look is moved downhill until the drawings are like the sharp pictures.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from evsplat.body import Body, BodyTrack, PoseErrors
from evsplat.body.pose_noise import PoseNoise, joint_angles
from evsplat.camera import Camera
from evsplat.capture import TrainingCapture
from evsplat.errors import DataError
from evsplat.posing.correction import Correction
from evsplat.posing.descent import COARSE_PX, LOOK_STEPS, PROBE_STEPS, PROBES, Descent, Stage
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import Targets, find_targets
from evsplat.posing.time_limit import TimeLimit

DISCS = 4_000
UNKNOWN_RAD, UNKNOWN_M = 0.05, 0.02
"""Errors expected of limb joints and of the root's place, per axis, where nobody says."""
LEAST_GAIN = 0.12
"""Share by which pictures kept aside must be explained better, for certain, for given poses to
count as wrong. What discs cannot show of a person moves true motions: exact poses of staged people
were explained up to 0.08 better, fitted ones of a real recording 0.15."""
_LEAST_AXIS = 0.5
_STEPS = (160, 140)
_LAST_STEPS = 40
"""Steps in which pictures kept aside are explained as well, once they have judged."""
_NEARER = 0.6
"""How near to the corrected body the background is taken for sure, in shares of before."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A corrected motion, and whether it is better than the given one."""

    track: BodyTrack
    """The corrected motion with its errors; `better` says whether to use it."""
    gain: float
    """Share by which it explains pictures better that neither motion was fitted to."""
    gain_error: float
    """Standard error of the gain over the frames."""
    given_errors: PoseErrors
    """Errors of the given motion, by how far the corrected one lies from it: for motions that don't
    say how far they err."""
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
    planned = 3 * LOOK_STEPS + sum(steps) + _LAST_STEPS + PROBES * PROBE_STEPS
    limit = TimeLimit(seconds, planned, progress=progress)
    targets = find_targets(track, capture)
    joint_rad, root_m = expected_errors(track)
    correction = Correction(track, joint_rad, root_m)
    look = SurfaceDiscs(track.body, discs, torch.Generator().manual_seed(seed))
    aside = _middles(targets)
    fitted = sorted(set(range(len(targets.times_us))) - set(aside)) or aside
    descent = Descent(correction, look, targets.rows(fitted), limit)
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
        correction.corrected(errors),
        gain,
        gain_error,
        _given_errors(correction),
        tuple(stages),
        time.monotonic() - began,
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


@torch.no_grad()
def _given_errors(correction: Correction) -> PoseErrors:
    """Errors of the motion that was corrected, root mean squares of the correction.

    Of the joints one factor on what was expected of each: the correction of a single joint may be
    another's, turned the other way. Of the root at least `_LEAST_AXIS` of its worst axis.
    """
    track = correction.track
    weights = correction.weights(track.times_us.tolist())
    turned = torch.einsum("tm,mjc->tjc", weights, correction.turns).square().mean().sqrt()
    joint_rad = np.zeros(track.poses.shape[:2])
    joint_rad[:, correction.joints.numpy()] = float(turned) * correction.joint_rad.numpy()
    moved = (correction.root_m * (weights @ correction.shifts)).square().mean(0).sqrt()
    root_m = moved.clamp_min(_LEAST_AXIS * float(moved.max())).double().numpy()
    return PoseErrors("estimated", joint_rad, np.tile(root_m, (len(joint_rad), 1)))


def _anatomical(body: Body) -> Float[np.ndarray, "J"]:
    noise = PoseNoise(UNKNOWN_RAD, UNKNOWN_RAD / 2, UNKNOWN_M, UNKNOWN_M)
    try:
        return joint_angles(body, noise)
    except DataError:  # a skeleton without names
        return np.full(len(body.parents), UNKNOWN_RAD)


def _middles(targets: Targets) -> list[int]:
    """Pictures of training frames that are nearest to the middle of each one's exposure."""
    best: dict[str, tuple[int, int]] = {}
    for number, (at, frame) in enumerate(zip(targets.times_us, targets.frames, strict=True)):
        if frame.split == "train":
            best[frame.name] = min(
                best.get(frame.name, (1 << 62, 0)), (abs(at - frame.mid_us), number)
            )
    return [number for _, number in best.values()]


def _gain(descent: Descent, aside: Targets) -> tuple[float, float]:
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
        descent.learn_look(descent.targets, 1, LOOK_STEPS)
        misfits.append(descent.misfits(aside))
    with torch.no_grad():
        for param, value in zip(params, found, strict=True):
            param.copy_(value)
    descent.look.load_state_dict(state)
    better = (misfits[1] / misfits[0]).log()
    spread = float(better.std()) if len(better) > 1 else math.inf
    return 1 - math.exp(-float(better.mean())), spread / math.sqrt(len(better))
