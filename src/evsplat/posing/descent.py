"""Motion and look of a person drawn as discs, moved downhill until drawings are like pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import PoseErrors
from evsplat.camera import Camera
from evsplat.gaussians import Adam
from evsplat.posing.correction import Correction
from evsplat.posing.misfit import misfits
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import Targets
from evsplat.posing.time_limit import TimeLimit
from evsplat.probes import random_signs

COARSE_PX = 64
"""Least side of the pictures that are compared first."""
LOOK_STEPS = 30
"""Steps in which the look alone is learned, at the start and where two motions are compared."""
_LEAST_RAD, _LEAST_M = 0.006, 0.004
"""Errors that discs make of true motions, per axis: clothes, hair and hands are not the body's."""
_UNSEEN = 0.5
"""Share of a turn's variance that pictures of one camera leave, however sharply they are drawn: the
curvature is that of each coordinate alone, and what one limb turns others make up for, as the look
does. Without it errors were 1.9 to 2.1 times what was told (man, three motions found); with it 1.1
to 1.3 times."""
_UNSEEN_ALONG = 0.3
"""The same of the root's distance from the camera, for which limbs that lean make up."""
_PIXEL_SHARE = 0.05
"""Independent values that a pixel's three colours count for: neighbours err alike."""
_COARSE_DISCS = 1_500
"""Discs drawn in the smallest pictures; twice as many in each next size, as far as there are."""
_RATES = {"motion": 0.05, "colours": 0.03, "offsets": 0.1, "light": 0.01}
_PARTS = 3
"""Every so many-th picture is drawn in a step."""
PROBES = 4
PROBE_STEPS = 2 * _PARTS
"""Steps that each takes as long as."""


class Descent:
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

    def run(self, shrink: int, steps: int, *, first: bool) -> None:
        """Adam on pictures smaller by a factor."""
        targets = self.targets.smaller(shrink) if shrink > 1 else self.targets
        known, self.discs = self.discs, self._discs(targets.camera)
        if self.discs > known:
            shown = targets.rows(torch.nonzero(targets.coloured)[:, 0].tolist())
            with torch.no_grad():
                poses = self.correction.at(shown.times_us)
            camera, image = shown.camera, shown.image
            self.look.colour_from(*poses, camera, image, first=known, count=self.discs)
        if first:
            self.learn_look(targets, shrink, LOOK_STEPS)
        motion = [self.correction.turns, self.correction.shifts]
        groups = [*self._look_groups(), {"params": motion, "rate": _RATES["motion"]}]
        self._descend(groups, targets, shrink, steps)

    def _discs(self, camera: Camera) -> int:
        """How many are drawn."""
        finer = max(1.0, min(camera.width, camera.height) / COARSE_PX)
        return min(len(self.look.colours), round(_COARSE_DISCS * finer))

    def learn_look(self, targets: Targets, shrink: int, steps: int) -> None:
        """Leave the motion as it is, and ask for no gradient of it."""
        motion = self.correction.turns, self.correction.shifts
        for held in motion:
            held.requires_grad_(False)
        try:
            self._descend(self._look_groups(), targets, shrink, steps)
        finally:
            for held in motion:
                held.requires_grad_(True)

    def _look_groups(self) -> list[dict[str, Any]]:
        look = self.look
        shape = [look.offsets, look.bone_offsets, look.inset, look.layer]
        return [
            {"params": [look.colours], "rate": _RATES["colours"]},
            {"params": shape, "rate": _RATES["offsets"]},
            {"params": [look.light], "rate": _RATES["light"]},
            {"params": [look.nearer], "rate": _RATES["motion"]},
        ]

    def _descend(
        self, groups: list[dict[str, Any]], targets: Targets, shrink: int, steps: int
    ) -> None:
        adam = Adam([{**g, "lr": g["rate"]} for g in groups], betas=(0.9, 0.98))
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
        drawn = self.look.drawn(rotations, transl, targets.camera, self.discs)
        return misfits(drawn, targets)

    @torch.no_grad()
    def misfits(self, targets: Targets) -> Float[Tensor, "P"]:
        """Mean per picture."""
        return self._differences(targets) / targets.weight.sum((1, 2)).clamp_min(1e-6)

    def errors(self) -> PoseErrors:
        """What is still unknown of the motion, by the curvature at the end (Laplace).

        The diagonal of the curvature from differences of gradients along random signs
        (Bekas et al., An estimator for the diagonal of a matrix, 2007); to the root's place comes
        what these gradients cannot see of its distance (`_distance`).
        """
        correction = self.correction
        generator = torch.Generator().manual_seed(0)
        params = [correction.turns, correction.shifts]
        total = [torch.zeros_like(p) for p in params]
        probes = 0
        for _ in self.limit.steps(PROBES, PROBE_STEPS):
            probes += 1
            signs = [random_signs(p, generator) for p in params]
            up, down = (self._gradient(params, signs, size) for size in (0.05, -0.05))
            for one, a, b, sign in zip(total, up, down, signs, strict=True):
                one += sign * (a - b) / 0.1
        # What pictures say of a coordinate goes with its share of the variance.
        shares = correction.mixing.square().mean(0)
        rates = [one.mean(0).clamp_min(0) / probes / shares.mean() for one in total]
        times = correction.key_times.tolist()
        weights = correction.weights(times).square()
        known = [1 / (1 + torch.einsum("m,...->m...", shares, rate)) for rate in rates]
        alone = torch.einsum("tm,mjc->tj", weights, known[0]) / 3
        joint = correction.joint_rad.square() * (_UNSEEN + (1 - _UNSEEN) * alone)
        root = correction.root_m.square() * (weights @ known[1]) + self._distance(times)
        joint = torch.minimum(joint + _LEAST_RAD**2, correction.joint_rad.square()).sqrt()
        root = torch.minimum(root + _LEAST_M**2, correction.root_m.square()).sqrt()
        joint_rad = np.zeros((len(times), len(correction.track.body.parents)))
        joint_rad[:, correction.joints.numpy()] = joint.detach().numpy()
        return PoseErrors("estimated", joint_rad, root.detach().double().numpy())

    @torch.no_grad()
    def _distance(self, times_us: Sequence[int]) -> Float[Tensor, "T 3"]:
        """Variances along the axes of the world, m^2, of a distance that pictures don't tell.

        Of the variance expected along the view before anything was seen, `_UNSEEN_ALONG` is left. A
        shift that lasts had variance c^2 there, and clothes, hair and shoes look like one of
        variance s^2. Pictures tell only the sum of both, which leaves ``c^2 s^2 / (c^2 + s^2)`` of
        each.
        """
        correction = self.correction
        along = self.look.nearer_m(correction.at(times_us)[1], self.targets.camera).square()
        hidden = along.sum(1, keepdim=True)
        view = along / hidden
        expected = (view * correction.root_m.square()).sum(1, keepdim=True)
        lasting = correction.weights(times_us).mean(0).square().sum() * expected
        return view * (_UNSEEN_ALONG * expected + lasting * hidden / (lasting + hidden))

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
