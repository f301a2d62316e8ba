"""Lamps of a room at learned places, and the soft shadows of the person in their light."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.body import skin
from evsplat.body.surface import SurfaceSamples
from evsplat.models.discs.shadow_grids import both_shadows, light_on_body, shadow_on_scene

_LEAST_WIDTH_M = 0.03
_START_DISTANCE_M = 3.0


class Lamps(nn.Module):
    """Points that light the person and that the person hides from the scene.

    Each has a direction from the middle of where the person goes and a distance along it; a lamp
    that moves far away is the sun.
    """

    center: Tensor
    up: Tensor

    def __init__(self, center: Float[Tensor, "3"], up: Float[Tensor, "3"], count: int) -> None:
        """They start around the zenith, 35 degrees from it, but the first which is there.

        ``center``: where the person goes, metres; ``up``: away from the floor.
        """
        super().__init__()
        self.register_buffer("center", center.clone())
        self.register_buffer("up", up.clone(), persistent=False)
        side = torch.linalg.cross(up, torch.eye(3)[int(up.abs().argmin())])
        side = nn.functional.normalize(side, dim=0)
        other = torch.linalg.cross(up, side)
        angles = torch.arange(count - 1) * (2 * torch.pi / max(count - 1, 1))
        around = angles.cos()[:, None] * side + angles.sin()[:, None] * other
        self.directions = nn.Parameter(torch.cat([up[None], up + 0.7 * around]))
        self.distances_log = nn.Parameter(torch.full((count,), _START_DISTANCE_M).log())

    def distances(self) -> Float[Tensor, "L"]:
        """Distances from the middle of where the person goes, metres."""
        return self.distances_log.exp()

    def places(self) -> Float[Tensor, "L 3"]:
        """In the world, metres."""
        directions = _Unit.apply(self.directions)
        return self.center + self.distances()[:, None] * directions


class _Unit(torch.autograd.Function):
    """Vectors of length 1; autograd would take 14 operations for the gradient instead of four."""

    @staticmethod
    def forward(ctx: Any, vectors: Float[Tensor, "L 3"]) -> Float[Tensor, "L 3"]:
        length = vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        unit = vectors / length
        ctx.save_for_backward(unit, length)
        return unit

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        unit, length = ctx.saved_tensors
        along = (upstream[0] * unit).sum(-1, keepdim=True)
        return torch.addcmul(upstream[0], along, unit, value=-1) / length


class BodyShadow(nn.Module):
    """A factor on the scene's colours, by lamps that the body hides softly.

    Each lamp has a share of the brightness that it gives and a width of its penumbra, both learned.
    Points of the body are seen from the lamp as round Gaussians of that width; a place of the scene
    behind them loses the share times ``1 - exp(-depth)``, and a place on the body itself (`lit`)
    the lamp's own light, by points that are nearer to the lamp.
    """

    caster_points: Tensor
    caster_weights: Tensor

    def __init__(self, casters: SurfaceSamples, lamps: int, *, on_body: bool = False) -> None:
        """``casters``: a few hundred samples of the canonical body.

        ``on_body``: whether they shade the body as well.
        """
        super().__init__()
        self.register_buffer("caster_points", casters.points, persistent=False)
        self.register_buffer("caster_weights", casters.weights, persistent=False)
        self.share_logits = nn.Parameter(torch.full((lamps,), -2.0))
        self.widths_log = nn.Parameter(torch.full((lamps,), -2.5))
        self.own_widths_log = nn.Parameter(torch.full((lamps,), -3.5)) if on_body else None
        """Of the shadows on the body, which lies right behind what casts them."""

    @property
    def on_body(self) -> bool:
        """Whether the body is shaded as well."""
        return self.own_widths_log is not None

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
        widths = _LEAST_WIDTH_M + self.widths_log.exp()
        return shadow_on_scene(body, places, lamps, widths, self.share_logits.sigmoid())

    def lit(
        self,
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "T N 3"],
        lamps: Float[Tensor, "L 3"],
    ) -> Float[Tensor, "L T N"]:
        """Share of each lamp's light, in 0..1, that reaches places on the body itself."""
        assert self.own_widths_log is not None
        widths = _LEAST_WIDTH_M + self.own_widths_log.exp()
        return light_on_body(body, places, lamps, widths)

    def both(
        self,
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "H W 3"],
        own: Float[Tensor, "K N 3"],
        lamps: Float[Tensor, "L 3"],
        at: slice,
    ) -> tuple[Float[Tensor, "T H W"], Float[Tensor, "L K N"]]:
        """As called, and `lit` at its ``own`` places, whose times are ``at`` among all.

        By the latter neither the body nor these places learn anything.
        """
        assert self.own_widths_log is not None
        widths = _LEAST_WIDTH_M + torch.stack([self.widths_log, self.own_widths_log]).exp()
        return both_shadows(body, places, own, lamps, widths, self.share_logits.sigmoid(), at)
