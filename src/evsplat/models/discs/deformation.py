"""How a person's shape changes in time beyond what their bones do: cloth, muscles, a bent trunk."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from evsplat.body import SurfaceSamples
from evsplat.models.kept import Kept
from evsplat.models.pose_spline import PoseSpline
from evsplat.neighbours import far_apart

_HANDLES = 100
_REACH_M = 0.07
"""Standard deviation of a handle's weight over its distance: neighbours are about as far apart."""
_UNIT_M = 0.01
"""What is learned is in units of it, as a rule."""
_KNOT_US = 200_000
"""Least time between knots. No less than between training frames where many are held out, either:
nothing would tell of a handle in between."""
_GAPS = 0.9
"""Share of the times between training frames that may be shorter."""


class Deformation(nn.Module):
    """Offsets of the canonical surface, smooth over the body and in time; zero at the start.

    Skinning moves all of a limb as its bones say; of what shoulders, hips and cloth do beyond that
    the pose alone does not tell. Handles spread over the body have offsets of their own, each a
    cubic B-spline in time, and what lies between them follows (Sumner et al., Embedded deformation
    for shape manipulation, 2007, without rotations). Their mean over the training frames is zero:
    what lasts is the canonical shape's. In another motion there are none.
    """

    weights: Tensor

    def __init__(
        self, frame_times_us: Sequence[int], surface: SurfaceSamples, *, freedom: float = 1.0
    ) -> None:
        """``surface``: points that discs are attached to, by their number.

        ``freedom``, 1 or more: so many times as many handles, nearer to each other, and offsets in
        units that are so many times as large.
        """
        super().__init__()
        self.unit_m = freedom * _UNIT_M
        handles, reach_m = round(freedom * _HANDLES), _REACH_M / freedom**0.5
        times = sorted(frame_times_us)
        gaps = np.diff(times) if len(times) > 1 else np.zeros(1)
        knot_us = max(_KNOT_US, 2 * float(np.median(gaps)), float(np.quantile(gaps, _GAPS)))
        self.spline = PoseSpline((times[0], times[-1]), knot_us, 0, centred_us=times, learned=False)
        self.handles = nn.Parameter(torch.zeros(self.spline.count, handles, 3))
        spread = surface.points[far_apart(surface.points, handles)]
        apart = torch.cdist(surface.points, spread)
        weights = torch.exp(-apart.square() / (2 * reach_m**2))
        weights = weights / weights.sum(1, keepdim=True)
        # A row for each handle: products of few rows with long ones are the faster.
        self.register_buffer("weights", weights.T.contiguous(), persistent=False)
        self._of_discs = Kept()

    def forward(self, index: Int[Tensor, "N"], times_us: Sequence[int]) -> Float[Tensor, "T N 3"]:
        """Offsets, canonical metres, of discs at the surface points ``index``."""
        handles = torch.einsum("tk,khc->tch", self.spline.weights(times_us), self.handles)
        weights: Tensor = self._of_discs.of([index], lambda: self.weights[:, index])
        moved = (self.unit_m * handles).flatten(0, 1) @ weights
        return moved.unflatten(0, (-1, 3)).mT

    def forget(self) -> None:
        """Set all offsets to zero."""
        with torch.no_grad():
            self.handles.zero_()

    def price(self) -> Float[Tensor, ""]:
        """Mean square, in the units that are learned."""
        return self.handles.square().mean()
