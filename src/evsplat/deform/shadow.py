"""Soft shadows that the person casts on the scene, from where the body is and learned lamps."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.body import skin
from evsplat.body.surface import SurfaceSamples

_REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
_CELLS = 49
_NEAREST_M = 0.1
_LEAST_WIDTH_M = 0.03
_DENSITY = 3.0
"""Optical depth through the middle of a body that covers `_AREA_M2` across the light."""
_AREA_M2 = 0.5


class BodyShadow(nn.Module):
    """A factor on the scene's colours, by lamps that the body hides softly.

    Each lamp has a share of the brightness that it gives and a width of its penumbra, both learned.
    Points of the body are seen from the lamp as round Gaussians of that width; a place of the scene
    behind them loses the share times ``1 - exp(-depth)``. A sum of round Gaussians on a grid is a
    product of two matrices, so that a shadow costs as good as nothing.
    """

    caster_points: Tensor
    caster_weights: Tensor

    def __init__(self, casters: SurfaceSamples, lamps: int) -> None:
        """``casters``: a few hundred samples of the canonical body."""
        super().__init__()
        self.register_buffer("caster_points", casters.points, persistent=False)
        self.register_buffer("caster_weights", casters.weights, persistent=False)
        self.share_logits = nn.Parameter(torch.full((lamps,), -2.0))
        self.widths_log = nn.Parameter(torch.full((lamps,), -2.5))

    def place(self, bones: Float[Tensor, "T J 4 4"]) -> Float[Tensor, "T P 3"]:
        """The casters in the world, for bone transforms from canonical space."""
        return skin(self.caster_points, self.caster_weights, bones)[0]

    def forward(
        self,
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "H W 3"],
        lamps: Float[Tensor, "L 3"],
    ) -> Float[Tensor, "T H W"]:
        """Factors in 0..1 at the scene's ``places`` for the casters at world points ``body``."""
        factor = places.new_ones(len(body), *places.shape[:2])
        for lamp, logit, width_log in zip(lamps, self.share_logits, self.widths_log, strict=True):
            width = _LEAST_WIDTH_M + width_log.exp()
            depth = self._depth(lamp, width, body, places)
            factor = factor * (1 - logit.sigmoid() * (1 - torch.exp(-depth)))
        return factor

    def _depth(
        self,
        lamp: Float[Tensor, "3"],
        width: Float[Tensor, ""],
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "H W 3"],
    ) -> Float[Tensor, "T H W"]:
        """Optical depth of the body between places and the lamp.

        All is seen from the lamp, on the plane through the body's middle that faces it.
        """
        ray = body.mean(1) - lamp
        distance = ray.norm(dim=-1)
        axis = ray / distance[:, None]
        across = _across(axis)
        grid = torch.linspace(-_REACH_M, _REACH_M, _CELLS, dtype=lamp.dtype, device=lamp.device)
        seen, _ = _project(body - lamp, axis, across, distance)
        bells = torch.exp(-0.5 * ((grid[:, None, None] - seen[:, None]) / width).square())
        scale = _DENSITY * _AREA_M2 / (body.shape[1] * 2 * torch.pi * width.square())
        density = scale * bells[..., 0] @ bells[..., 1].transpose(1, 2)
        at, along = _project((places - lamp).flatten(0, 1)[None], axis, across, distance)
        at, along = (values.unflatten(1, places.shape[:2]) for values in (at, along))
        # grid_sample wants the coordinate along the last axis first.
        sampled = nn.functional.grid_sample(
            density[:, None], at.flip(-1) / _REACH_M, align_corners=True
        )[:, 0]
        behind = along - distance[:, None, None]
        return sampled * torch.sigmoid((behind + 0.2) / 0.1)


def _project(
    points: Float[Tensor, "#T N 3"],
    axis: Float[Tensor, "T 3"],
    across: Float[Tensor, "T 2 3"],
    distance: Float[Tensor, "T"],
) -> tuple[Float[Tensor, "T N 2"], Float[Tensor, "T N"]]:
    """Points relative to a lamp on the plane at ``distance`` before it, and how far along they are.

    In metres on that plane.
    """
    along = (points @ axis[..., None])[..., 0]
    spread = distance[:, None] / along.clamp_min(_NEAREST_M)
    return (points @ across.transpose(1, 2)) * spread[..., None], along


def _across(axis: Float[Tensor, "T 3"]) -> Float[Tensor, "T 2 3"]:
    """Two unit vectors at right angles to ``axis`` and each other (Duff et al. 2017, JCGT 6)."""
    x, y, z = axis.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z.detach())
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y], -1)], -2)
