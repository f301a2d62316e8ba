"""Soft shadows that the person casts on the scene, from where the body is and learned lights."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.body import skin
from evsplat.body.surface import SurfaceSamples

_REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
_CELLS = 49
_LEAST_WIDTH_M = 0.03
_DENSITY = 3.0
"""Optical depth through the middle of a body that covers `_AREA_M2` across the light."""
_AREA_M2 = 0.5


class BodyShadow(nn.Module):
    """A factor on the scene's colours, by distant lights that the body hides softly.

    Each light has a direction, a share of the brightness that it gives, and a width of its
    penumbra; all are learned. Points of the body are seen along the light as round Gaussians of
    that width; a place of the scene behind them loses the share times ``1 - exp(-depth)``. A sum of
    round Gaussians on a grid is a product of two matrices, so that a shadow costs as good as
    nothing.
    """

    caster_points: Tensor
    caster_weights: Tensor

    def __init__(self, casters: SurfaceSamples, up: Float[Tensor, "3"], lights: int = 4) -> None:
        """``casters``: a few hundred samples of the canonical body; ``up``: away from the floor.

        Lights start around the zenith, 35 degrees from it, but the first which is there.
        """
        super().__init__()
        self.register_buffer("caster_points", casters.points, persistent=False)
        self.register_buffer("caster_weights", casters.weights, persistent=False)
        side = torch.linalg.cross(up, torch.eye(3)[int(up.abs().argmin())])
        side = nn.functional.normalize(side, dim=0)
        other = torch.linalg.cross(up, side)
        angles = torch.arange(lights - 1) * (2 * torch.pi / max(lights - 1, 1))
        around = angles.cos()[:, None] * side + angles.sin()[:, None] * other
        self.directions = nn.Parameter(torch.cat([up[None], up + 0.7 * around]))
        self.share_logits = nn.Parameter(torch.full((lights,), -2.0))
        self.widths_log = nn.Parameter(torch.full((lights,), -2.5))

    def place(self, bones: Float[Tensor, "T J 4 4"]) -> Float[Tensor, "T P 3"]:
        """The casters in the world, for bone transforms from canonical space."""
        return skin(self.caster_points, self.caster_weights, bones)[0]

    def forward(
        self, body: Float[Tensor, "T P 3"], places: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, "T H W"]:
        """Factors in 0..1 at the scene's ``places`` for the casters at world points ``body``."""
        factor = places.new_ones(len(body), *places.shape[:2])
        middle = body.mean(1)
        for direction, logit, width_log in zip(
            self.directions, self.share_logits, self.widths_log, strict=True
        ):
            light = nn.functional.normalize(direction, dim=0)
            width = _LEAST_WIDTH_M + width_log.exp()
            depth = self._depth(light, width, body - middle[:, None], places, middle)
            factor = factor * (1 - logit.sigmoid() * (1 - torch.exp(-depth)))
        return factor

    def _depth(
        self,
        light: Float[Tensor, "3"],
        width: Float[Tensor, ""],
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "H W 3"],
        middle: Float[Tensor, "T 3"],
    ) -> Float[Tensor, "T H W"]:
        """Optical depth of the body between places and the light."""
        across = _across(light)
        grid = torch.linspace(-_REACH_M, _REACH_M, _CELLS, dtype=light.dtype, device=light.device)
        seen = body @ across.T
        bells = torch.exp(-0.5 * ((grid[:, None, None] - seen[:, None]) / width).square())
        scale = _DENSITY * _AREA_M2 / (body.shape[1] * 2 * torch.pi * width.square())
        density = scale * bells[..., 0] @ bells[..., 1].transpose(1, 2)
        at = places @ across.T - (middle @ across.T)[:, None, None]
        # grid_sample wants the coordinate along the last axis first.
        sampled = nn.functional.grid_sample(
            density[:, None], at.flip(-1) / _REACH_M, align_corners=True
        )[:, 0]
        towards = (middle @ light)[:, None, None] - places @ light
        return sampled * torch.sigmoid((towards + 0.2) / 0.1)


def _across(light: Float[Tensor, "3"]) -> Float[Tensor, "2 3"]:
    """Two unit vectors at right angles to ``light`` and each other (Duff et al. 2017, JCGT 6)."""
    x, y, z = light.unbind()
    sign = torch.copysign(torch.ones_like(z), z.detach())
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x])
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y])])
