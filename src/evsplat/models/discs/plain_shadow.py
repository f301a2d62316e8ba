"""Shadows of round Gaussians in plain torch, on any device and in any precision.

Autograd would take twice as many operations for the gradients, and as many again to add them up,
which is what a GPU waits for: they are written out here.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
_CELLS = 49
_LAYERS = 31
"""Of the space around the body along the light, in which it shades itself."""
_LAYER_EDGE_M = 0.03
_OWN_SURFACE_M = 0.12
"""How far nearer to the lamp a part of the body must be to shade another."""
_BEHIND_M, _BEHIND_EDGE_M = -0.2, 0.1
"""From where on behind the body's middle the scene is shaded, and how softly that begins."""
_NEAREST_M = 0.1
DENSITY = 3.0
"""Optical depth through the middle of a body that covers `AREA_M2` across the light."""
AREA_M2 = 0.5


def shadow_on_places(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "N 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "L"],
    shares: Float[Tensor, "L"],
) -> Float[Tensor, "T N"]:
    """As `shadow_on_scene` at places in a row."""
    factors: Tensor = _OnScene.apply(body, places, lamps, widths, shares)
    return factors


def light_on_places(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "T N 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "L"],
) -> Float[Tensor, "L T N"]:
    """As `light_on_body`."""
    light: Tensor = _OnBody.apply(body, places, lamps, widths)
    return light


class _OnScene(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, body: Tensor, places: Tensor, lamps: Tensor, widths: Tensor, shares: Tensor
    ) -> Float[Tensor, "T N"]:
        views = _Views.of(lamps, body)
        seen = views.project(body, places.expand(len(body), -1, -1))
        bells = _Bells.at(seen.cast, widths)
        scale = _scale(body, widths)
        density = scale * (bells.across @ bells.down.mT)
        at, behind = seen.at[:, :, views.count :], seen.behind[:, :, views.count :]
        sampled, grid = _sample(density.flatten(0, 1)[:, None], at.flatten(0, 1)[:, None])
        sampled = sampled.view(behind.shape)
        gate = torch.sigmoid((behind - _BEHIND_M) / _BEHIND_EDGE_M)
        lost = 1 - torch.exp(-sampled * gate)
        factors = 1 - shares[:, None, None] * lost
        ctx.parts = views, seen, bells
        ctx.save_for_backward(widths, shares, scale, density, grid, sampled, gate, lost, factors)
        return factors.prod(0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        views, seen, bells = ctx.parts
        widths, shares, scale, density, grid, sampled, gate, lost, factors = ctx.saved_tensors
        tiny = torch.finfo(factors.dtype).tiny
        by_lost = -upstream[0] * factors.prod(0) / factors.clamp_min(tiny)
        by_share = (by_lost * lost).sum((1, 2))
        by_depth = by_lost * shares[:, None, None] * (1 - lost)
        by_gate = by_depth * sampled * gate * ((1 - gate) / _BEHIND_EDGE_M)
        by_density, by_at = _sample_backward(by_depth * gate, density.flatten(0, 1)[:, None], grid)
        by_density, by_at = by_density.view_as(density), by_at.view(*by_gate.shape, 2)
        scaled = scale * by_density
        by_cast, by_width = bells.backward(scaled @ bells.down, scaled.mT @ bells.across)
        by_width = _of_scale(by_width, by_density, density, widths)
        by_lamps, by_body, by_places = views.backward(
            seen, torch.cat([by_cast, by_at], 2), F.pad(by_gate, (views.count, 0))
        )
        return by_body, by_places.sum(0), by_lamps, by_width, by_share


class _OnBody(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, body: Tensor, places: Tensor, lamps: Tensor, widths: Tensor
    ) -> Float[Tensor, "L T N"]:
        views = _Views.of(lamps, body)
        seen = views.project(body, places)
        bells = _Bells.at(seen.cast, widths)
        scale = _scale(body, widths)
        in_front = seen.behind[:, :, : views.count]
        layers = torch.linspace(-REACH_M, REACH_M, _LAYERS, dtype=lamps.dtype, device=lamps.device)
        nearer = torch.sigmoid((layers[:, None] - in_front[:, :, None]) / _LAYER_EDGE_M)
        rows = (nearer[:, :, :, None] * bells.across[:, :, None]).flatten(2, 3)
        density = scale * (rows @ bells.down.mT)
        at, behind = seen.at[:, :, views.count :], seen.behind[:, :, views.count :]
        where = torch.cat([at, (behind - _OWN_SURFACE_M)[..., None]], -1)
        depth, grid = _sample(
            density.flatten(0, 1).unflatten(1, (1, _LAYERS, _CELLS)),
            where.flatten(0, 1)[:, None, None],
        )
        light = torch.exp(-depth.view(behind.shape))
        ctx.parts = views, seen, bells
        ctx.save_for_backward(widths, scale, density, grid, nearer, rows, light)
        return light

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        views, seen, bells = ctx.parts
        widths, scale, density, grid, nearer, rows, light = ctx.saved_tensors
        layered = density.flatten(0, 1).unflatten(1, (1, _LAYERS, _CELLS))
        by_density, by_where = _sample_backward(-upstream[0] * light, layered, grid)
        by_density = by_density.view_as(density)
        by_where = by_where.view(*light.shape, 3)
        scaled = scale * by_density
        by_rows = (scaled @ bells.down).unflatten(2, (_LAYERS, _CELLS))
        by_across = (by_rows * nearer[:, :, :, None]).sum(2)
        by_nearer = (by_rows * bells.across[:, :, None]).sum(3)
        by_behind = (by_nearer * nearer * (nearer - 1)).sum(2) / _LAYER_EDGE_M
        by_cast, by_width = bells.backward(by_across, scaled.mT @ rows)
        by_width = _of_scale(by_width, by_density, density, widths)
        by_lamps, by_body, by_places = views.backward(
            seen,
            torch.cat([by_cast, by_where[..., :2]], 2),
            torch.cat([by_behind, by_where[..., 2]], 2),
        )
        return by_body, by_places, by_lamps, by_width


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points on the plane through the body's middle that faces a lamp: the body's P, then places.

    Together, since each operation on both is one launch of a GPU.
    """

    rays: Float[Tensor, "L T P+N 3"]
    """From the lamp, world axes."""
    along: Float[Tensor, "L T P+N"]
    """The light, from the lamp."""
    spread: Float[Tensor, "L T P+N"]
    """Of the plane by what lies in front of it."""
    at: Float[Tensor, "L T P+N 2"]
    behind: Float[Tensor, "L T P+N"]
    """How far behind the plane, metres."""
    cast: Float[Tensor, "L T P 2"]
    """Where the body's own are."""


@dataclass(frozen=True, eq=False)
class _Views:
    """The lamps' axes: two across the light (`_across`), and along it towards the body's middle."""

    lamps: Float[Tensor, "L 3"]
    frames: Float[Tensor, "L T 3 3"]
    twist: Float[Tensor, "L T 3"]
    """By how much the axes turn about the light as that turns."""
    distance: Float[Tensor, "L T 1"]
    count: int
    """Points of the body."""

    @classmethod
    def of(cls, lamps: Float[Tensor, "L 3"], body: Float[Tensor, "T P 3"]) -> "_Views":
        ray = body.mean(1) - lamps[:, None]
        distance = ray.norm(dim=-1, keepdim=True)
        axis = ray / distance
        across, twist = _across(axis)
        frames = torch.cat([across, axis[..., None, :]], -2)
        return cls(lamps, frames, twist, distance, body.shape[1])

    def project(self, body: Float[Tensor, "T P 3"], places: Float[Tensor, "T N 3"]) -> _Seen:
        rays = torch.cat([body, places], 1) - self.lamps[:, None, None]
        local = rays @ self.frames.mT
        along = local[..., 2]
        spread = self.distance / along.clamp_min(_NEAREST_M)
        at = local[..., :2] * spread[..., None]
        return _Seen(rays, along, spread, at, along - self.distance, at[:, :, : self.count])

    def backward(
        self,
        seen: _Seen,
        by_at: Float[Tensor, "L T P+N 2"],
        by_behind: Float[Tensor, "L T P+N"],
    ) -> tuple[Float[Tensor, "L 3"], Float[Tensor, "T P 3"], Float[Tensor, "T N 3"]]:
        """Gradients of lamps, body and places from those of what `project` gave."""
        reach = (by_at * seen.at).sum(-1) / self.distance
        nears = seen.spread * (seen.along > _NEAREST_M)
        by_along = torch.addcmul(by_behind, reach, nears, value=-1)
        by_distance = (reach - by_behind).sum(-1, keepdim=True)
        by_local = torch.cat([by_at * seen.spread[..., None], by_along[..., None]], -1)
        by_rays = by_local @ self.frames
        by_ray = self._by_ray(by_local.mT @ seen.rays, by_distance)
        by_points = by_rays.sum(0)
        by_lamps = -by_ray.sum(1) - by_rays.sum((1, 2))
        by_body = by_points[:, : self.count] + by_ray.sum(0)[:, None] / self.count
        return by_lamps, by_body, by_points[:, self.count :]

    def _by_ray(
        self, by_frame: Float[Tensor, "L T 3 3"], by_distance: Float[Tensor, "L T 1"]
    ) -> Float[Tensor, "L T 3"]:
        """Gradient of the way from the lamp to the body's middle."""
        axis = self.frames[..., 2, :]
        turned = by_frame @ self.frames.mT
        about = turned[..., 0, 1] - turned[..., 1, 0]
        by_axis = by_frame[..., 2, :] - (turned[..., :2, 2:] * self.frames[..., :2, :]).sum(-2)
        by_axis = torch.addcmul(by_axis, about[..., None], self.twist)
        # Only what turns the axis, and what makes the ray longer.
        along = (by_axis * axis).sum(-1, keepdim=True)
        return torch.addcmul((by_axis - along * axis) / self.distance, by_distance, axis)


@dataclass(frozen=True, eq=False)
class _Bells:
    """Round Gaussians at points of the plane, one factor per axis, at the cells of the grid."""

    widths: Float[Tensor, "L 1 1 1"]
    away: Float[Tensor, "2 L T C P"]
    """Of the cells from the points, in widths."""
    values: Float[Tensor, "2 L T C P"]

    @classmethod
    def at(cls, at: Float[Tensor, "L T P 2"], widths: Float[Tensor, "L"]) -> "_Bells":
        wide = widths[:, None, None, None]
        grid = torch.linspace(-REACH_M, REACH_M, _CELLS, dtype=at.dtype, device=at.device)
        away = (grid[:, None] - at.movedim(-1, 0)[..., None, :]) / wide
        return cls(wide, away, torch.exp(-0.5 * away.square()))

    @property
    def across(self) -> Float[Tensor, "L T C P"]:
        return self.values[0]

    @property
    def down(self) -> Float[Tensor, "L T C P"]:
        return self.values[1]

    def backward(
        self, by_across: Float[Tensor, "L T C P"], by_down: Float[Tensor, "L T C P"]
    ) -> tuple[Float[Tensor, "L T P 2"], Float[Tensor, "L"]]:
        """Gradients of the points and the widths."""
        slopes = torch.stack([by_across, by_down]) * self.values * self.away / self.widths
        return slopes.sum(-2).movedim(0, -1), (slopes * self.away).sum((0, 2, 3, 4))


def _scale(body: Float[Tensor, "T P 3"], widths: Float[Tensor, "L"]) -> Float[Tensor, "L 1 1 1"]:
    scale = DENSITY * AREA_M2 / (body.shape[1] * 2 * torch.pi)
    return (scale * widths.pow(-2))[:, None, None, None]


def _of_scale(by_width: Tensor, by_density: Tensor, density: Tensor, widths: Tensor) -> Tensor:
    """The widths' gradient with that of `_scale` added."""
    total = (by_density * density).sum((1, 2, 3))
    return torch.addcdiv(by_width, total, widths, value=-2)


def _sample(
    grids: Float[Tensor, "M 1 *cells"], places: Float[Tensor, "M *one N D"]
) -> tuple[Tensor, Tensor]:
    """Values of the grids at places, metres along their axes; and the places as torch has them."""
    # grid_sample wants the coordinate along the last axis first.
    at = _as_sampled(places)
    return F.grid_sample(grids, at, align_corners=True), at


def _sample_backward(above: Tensor, grids: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of grids and places, metres."""
    flat = grids.dim() == 4
    run = (
        torch.ops.aten.grid_sampler_2d_backward if flat else torch.ops.aten.grid_sampler_3d_backward
    )
    above = above.reshape(len(grids), 1, *at.shape[1:-1]).contiguous()
    by_grids, by_at = run(above, grids, at, 0, 0, True, [True, True])
    return by_grids, _as_sampled(by_at)


def _as_sampled(places: Tensor) -> Tensor:
    if places.shape[-1] == 2:
        return places.flip(-1) / REACH_M
    return torch.cat([places[..., :2].flip(-1), places[..., 2:]], -1) / REACH_M


def _across(axis: Float[Tensor, "*T 3"]) -> tuple[Float[Tensor, "*T 2 3"], Float[Tensor, "*T 3"]]:
    """Two unit vectors at right angles to ``axis`` and each other (Duff et al. 2017, JCGT 6).

    They are the first rows of the reflection that takes the axis to the z axis or its opposite; the
    second one turns with the sign. And their twist: how far the first one moves along the second
    for a small move of the axis is the product with it.
    """
    sign = torch.copysign(torch.ones_like(axis[..., 2:]), axis[..., 2:])
    between = axis + F.pad(sign, (2, 0))
    ratio = between[..., :2] / between[..., 2:]
    identity = torch.eye(3, dtype=axis.dtype, device=axis.device)[:2]
    # The identity less (ratio * sign) between.
    rows = torch.addcmul(identity, (ratio * sign)[..., None], between[..., None, :], value=-1)
    twist = F.pad(torch.stack([ratio[..., 1], -ratio[..., 0]], -1), (0, 1))
    return rows * F.pad(sign, (1, 0), value=1.0)[..., None], twist
