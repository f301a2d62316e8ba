"""Prior that keeps learned pose residuals small and smooth where the recording says little."""

from collections.abc import Sequence

import torch
from torch import Tensor

from evsplat.capture import Frame
from evsplat.models.discs import DiscModel
from evsplat.objectives.base import Stateless, Step


class PosePrior(Stateless):
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

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """No renders."""
        return ()

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
