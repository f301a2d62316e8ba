"""Lamps of a room at learned places, and the soft shadows of the person in their light."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.body import skin
from evsplat.body.surface import SurfaceSamples

_REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
_CELLS = 49
_LAYERS = 31
"""Of the space around the body along the light, in which it shades itself."""
_LAYER_EDGE_M = 0.03
_OWN_SURFACE_M = 0.12
"""How far nearer to the lamp a part of the body must be to shade another."""
_NEAREST_M = 0.1
_LEAST_WIDTH_M = 0.03
_DENSITY = 3.0
"""Optical depth through the middle of a body that covers `_AREA_M2` across the light."""
_AREA_M2 = 0.5
_START_DISTANCE_M = 3.0


class Lamps(nn.Module):
    """Points that light the person and that the person hides from the scene.

    Each has a direction from the middle of where the person goes and a distance along it; a lamp
    that moves far away is the sun.
    """

    center: Tensor

    def __init__(self, center: Float[Tensor, "3"], up: Float[Tensor, "3"], count: int) -> None:
        """They start around the zenith, 35 degrees from it, but the first which is there.

        ``center``: where the person goes, metres; ``up``: away from the floor.
        """
        super().__init__()
        self.register_buffer("center", center.clone())
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
        directions = nn.functional.normalize(self.directions, dim=-1)
        return self.center + self.distances()[:, None] * directions


class BodyShadow(nn.Module):
    """A factor on the scene's colours, by lamps that the body hides softly.

    Each lamp has a share of the brightness that it gives and a width of its penumbra, both learned.
    Points of the body are seen from the lamp as round Gaussians of that width; a place of the scene
    behind them loses the share times ``1 - exp(-depth)``, and a place on the body itself (`lit`)
    the lamp's own light, by points that are nearer to the lamp. A sum of round Gaussians on a grid
    is a product of two matrices, so that a shadow costs as good as nothing.
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
        factor = places.new_ones(len(body), *places.shape[:2])
        for lamp, logit, width_log in zip(lamps, self.share_logits, self.widths_log, strict=True):
            width = _LEAST_WIDTH_M + width_log.exp()
            depth = self._depth(lamp, width, body, places)
            factor = factor * (1 - logit.sigmoid() * (1 - torch.exp(-depth)))
        return factor

    def lit(
        self,
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "T N 3"],
        lamps: Float[Tensor, "L 3"],
    ) -> Float[Tensor, "L T N"]:
        """Share of each lamp's light, in 0..1, that reaches places on the body itself."""
        assert self.own_widths_log is not None
        return torch.stack(
            [
                torch.exp(-self._depth_before(lamp, _LEAST_WIDTH_M + width_log.exp(), body, places))
                for lamp, width_log in zip(lamps, self.own_widths_log, strict=True)
            ]
        )

    def _depth(
        self,
        lamp: Float[Tensor, "3"],
        width: Float[Tensor, ""],
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "H W 3"],
    ) -> Float[Tensor, "T H W"]:
        """Optical depth of the body between places and the lamp."""
        view = _LampView.of(lamp, body)
        across, down = _bells(view.project(body)[0], width)
        density = _scale(body, width) * across @ down.transpose(1, 2)
        at, behind = view.project(places.flatten(0, 1)[None])
        at, behind = (values.unflatten(1, places.shape[:2]) for values in (at, behind))
        # grid_sample wants the coordinate along the last axis first.
        sampled = nn.functional.grid_sample(
            density[:, None], at.flip(-1) / _REACH_M, align_corners=True
        )[:, 0]
        return sampled * torch.sigmoid((behind + 0.2) / 0.1)

    def _depth_before(
        self,
        lamp: Float[Tensor, "3"],
        width: Float[Tensor, ""],
        body: Float[Tensor, "T P 3"],
        places: Float[Tensor, "T N 3"],
    ) -> Float[Tensor, "T N"]:
        """Optical depth of those parts of the body that are nearer to the lamp than places on it.

        In layers along the light, each of which holds what is nearer.
        """
        view = _LampView.of(lamp, body)
        at, behind = view.project(body)
        layers = torch.linspace(-_REACH_M, _REACH_M, _LAYERS, dtype=lamp.dtype, device=lamp.device)
        nearer = torch.sigmoid((layers[:, None] - behind[:, None]) / _LAYER_EDGE_M)
        across, down = _bells(at, width)
        rows = (nearer[:, :, None] * across[:, None]).flatten(1, 2)
        density = _scale(body, width) * rows @ down.transpose(1, 2)
        at, behind = view.project(places)
        seen = torch.cat([at.flip(-1), (behind - _OWN_SURFACE_M)[..., None]], -1)
        return nn.functional.grid_sample(
            density.unflatten(1, (_LAYERS, _CELLS))[:, None],
            seen[:, None, None] / _REACH_M,
            align_corners=True,
        )[:, 0, 0, 0]


@dataclass(frozen=True, eq=False)
class _LampView:
    """View of a lamp: the plane through the body's middle that faces it."""

    lamp: Float[Tensor, "3"]
    axis: Float[Tensor, "T 3"]
    across: Float[Tensor, "T 2 3"]
    distance: Float[Tensor, "T"]

    @classmethod
    def of(cls, lamp: Float[Tensor, "3"], body: Float[Tensor, "T P 3"]) -> "_LampView":
        ray = body.mean(1) - lamp
        distance = ray.norm(dim=-1)
        axis = ray / distance[:, None]
        return cls(lamp, axis, _across(axis), distance)

    def project(
        self, points: Float[Tensor, "#T N 3"]
    ) -> tuple[Float[Tensor, "T N 2"], Float[Tensor, "T N"]]:
        """Points on the plane, and how far behind it they are, metres."""
        points = points - self.lamp
        along = (points @ self.axis[..., None])[..., 0]
        spread = self.distance[:, None] / along.clamp_min(_NEAREST_M)
        at = (points @ self.across.transpose(1, 2)) * spread[..., None]
        return at, along - self.distance[:, None]


def _bells(
    at: Float[Tensor, "T P 2"], width: Float[Tensor, ""]
) -> tuple[Float[Tensor, "T C P"], Float[Tensor, "T C P"]]:
    """Round Gaussians at points of the plane, one factor per axis, at the cells of the grid."""
    grid = torch.linspace(-_REACH_M, _REACH_M, _CELLS, dtype=at.dtype, device=at.device)
    bells = torch.exp(-0.5 * ((grid[:, None, None] - at[:, None]) / width).square())
    return bells[..., 0], bells[..., 1]


def _scale(body: Float[Tensor, "T P 3"], width: Float[Tensor, ""]) -> Float[Tensor, ""]:
    return _DENSITY * _AREA_M2 / (body.shape[1] * 2 * torch.pi * width.square())


def _across(axis: Float[Tensor, "T 3"]) -> Float[Tensor, "T 2 3"]:
    """Two unit vectors at right angles to ``axis`` and each other (Duff et al. 2017, JCGT 6)."""
    x, y, z = axis.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z.detach())
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y], -1)], -2)
