"""Priors: skinning near the body model's weights, pose residuals small and smooth."""

from collections.abc import Sequence

import torch
from torch import Tensor

from evsplat.body import SurfaceSamples
from evsplat.devices import send
from evsplat.models.discs import DiscModel
from evsplat.models.paper import PaperModel
from evsplat.objectives.base import Objective, Step


class PosePrior(Objective):
    """Mean over given times, moving joints and axes of squares in units of what is expected.

    ``r^2 + stiffness * gap * r''^2``: the negative logarithm of the probability of errors that are
    new in every key pose on a motion that bends as the smoothed one does, if the poses were
    smoothed with the same stiffness (see `evsplat.body.smoothing`).
    """

    def __init__(self, times_us: Sequence[int]) -> None:
        """``times_us``: of the key poses, or between them where those are exact."""
        self.times_us = list(times_us)
        span = self.times_us[-1] - self.times_us[0]
        self.gap_s = 1e-6 * span / max(1, len(self.times_us) - 1)

    def loss(self, step: Step[DiscModel]) -> dict[str, Tensor]:
        """``pose_prior``, once residuals are learned."""
        spline = step.model.residual
        if spline is None or not step.model.residual_active:
            return {}
        weights = spline.weights(self.times_us)
        bends = spline.weights(self.times_us, derivative=2)
        moving = (spline.joint_rad > 0).float()[:, None]
        joints = self._price(weights, bends, spline.rotations * moving, spline.joint_stiffness)
        root = self._price(weights, bends, spline.translations[:, None], spline.root_stiffness)
        return {"pose_prior": (joints.sum() + root.sum()) / (moving.sum() + 1)}

    def _price(self, weights: Tensor, bends: Tensor, points: Tensor, stiffness: Tensor) -> Tensor:
        """Mean over keys and axes for each of J elements, of control points (K, J, 3)."""
        value = torch.einsum("tk,kjc->tjc", weights, points).square().mean((0, 2))
        bend = torch.einsum("tk,kjc->tjc", bends, points).square().mean((0, 2))
        return value + stiffness * self.gap_s * bend


class SkinningPrior(Objective):
    """Mean over surface points of the squared weight error, summed over joints (1.6)."""

    def __init__(self, surface: SurfaceSamples, points_per_step: int) -> None:
        """``surface``: samples of the canonical body, drawn once; each step uses a few of them."""
        self.surface, self.points_per_step = surface, points_per_step

    def loss(self, step: Step[PaperModel]) -> dict[str, Tensor]:
        """``skinning``: see `of`."""
        return {"skinning": self.of(step.model, step.generator)}

    def of(self, model: PaperModel, generator: torch.Generator) -> Tensor:
        """The prior of a model, at random surface points."""
        chosen = torch.randint(
            len(self.surface.points), (self.points_per_step,), generator=generator
        )
        chosen = send(chosen, self.surface.points.device)
        weights = model.skinning_weights(self.surface.points[chosen])
        return (weights - self.surface.weights[chosen]).square().sum(-1).mean()
