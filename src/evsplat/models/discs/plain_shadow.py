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

from evsplat.devices import constant
from evsplat.models.discs.shadow_views import CELLS, REACH_M, Bells, Views, evenly

_LAYERS = 31
"""Of the space around the body along the light, in which it shades itself."""
_LAYER_EDGE_M = 0.03
_OWN_SURFACE_M = 0.12
"""How far nearer to the lamp a part of the body must be to shade another."""
_BEHIND_M, _BEHIND_EDGE_M = -0.2, 0.1
"""From where on behind the body's middle the scene is shaded, and how softly that begins."""
DENSITY = 3.0
"""Optical depth through the middle of a body that covers `AREA_M2` across the light."""
AREA_M2 = 0.5
_sigmoid_slope = torch.ops.aten.sigmoid_backward
"""Gradient by what a sigmoid was taken of, from its own gradient and value."""


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


def shadow_and_light(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "N 3"],
    own: Float[Tensor, "K M 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "2 L"],
    shares: Float[Tensor, "L"],
    at: slice,
) -> tuple[Float[Tensor, "T N"], Float[Tensor, "L K M"]]:
    """`shadow_on_places`, and `light_on_places` of the times ``at``: seen by each lamp together.

    ``widths``: of the former and of the latter. Of the latter neither the body nor its ``own``
    places get a gradient.
    """
    both: tuple[Tensor, Tensor] = _Together.apply(body, places, own, lamps, widths, shares, at)
    return both


class _OnScene(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, body: Tensor, places: Tensor, lamps: Tensor, widths: Tensor, shares: Tensor
    ) -> Float[Tensor, "T N"]:
        views = Views.of(lamps, body)
        seen = views.project(body, places.expand(len(body), -1, -1))
        bells = Bells.at(seen.cast, widths[:, None])
        at, behind = seen.at[:, :, views.count :], seen.behind[:, :, views.count :]
        scene = _Scene.of(bells.values, _scale(body, widths[:, None]), at, behind, shares)
        ctx.parts = views, seen, bells, scene
        ctx.save_for_backward(widths)
        return scene.all

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        views, seen, bells, scene = ctx.parts
        (widths,) = ctx.saved_tensors
        slopes = scene.backward(upstream[0])
        by_cast, by_width = bells.backward(slopes.across, slopes.down)
        by_width = slopes.of_width(by_width.sum(1), widths)
        by_lamps, by_body, by_places = views.backward(
            seen,
            torch.cat([by_cast, slopes.at], 2),
            F.pad(slopes.behind, (views.count, 0)),
        )
        return by_body, by_places.sum(0), by_lamps, by_width, slopes.share


class _OnBody(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, body: Tensor, places: Tensor, lamps: Tensor, widths: Tensor
    ) -> Float[Tensor, "L T N"]:
        views = Views.of(lamps, body)
        seen = views.project(body, places)
        bells = Bells.at(seen.cast, widths[:, None])
        in_front, behind = seen.behind.tensor_split([views.count], 2)
        scale = _scale(body, widths[:, None])
        own, light = _Own.of(bells.values, scale, in_front, seen.at[:, :, views.count :], behind)
        ctx.parts = views, seen, bells, own
        ctx.save_for_backward(widths, light)
        return light

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        views, seen, bells, own = ctx.parts
        widths, light = ctx.saved_tensors
        slopes = own.backward(upstream[0], light)
        by_cast, by_width = bells.backward(slopes.across, slopes.down)
        by_width = slopes.of_width(by_width.sum(1), widths)
        by_lamps, by_body, by_places = views.backward(
            seen, torch.cat([by_cast, slopes.at], 2), slopes.behind
        )
        return by_body, by_places, by_lamps, by_width


class _Together(torch.autograd.Function):
    """Rows are the T times of the scene, then those of the body's own places.

    Where one has fewer places than the other, the rest stand in the origin and count for nothing.
    """

    @staticmethod
    def forward(
        ctx: Any,
        body: Tensor,
        places: Tensor,
        own: Tensor,
        lamps: Tensor,
        widths: Tensor,
        shares: Tensor,
        at: slice,
    ) -> tuple[Float[Tensor, "T N"], Float[Tensor, "L K M"]]:
        times, count, most = len(body), len(places), max(len(places), own.shape[1])
        rows = torch.cat([body, body[at]])
        shown = _padded(places[None], most).expand(times, -1, -1)
        each = widths[0, :, None].expand(-1, times), widths[1, :, None].expand(-1, len(own))
        wide = torch.cat(each, 1)
        views = Views.of(lamps, rows)
        seen = views.project(rows, torch.cat([shown, _padded(own, most)]))
        bells, scale = Bells.at(seen.cast, wide), _scale(rows, wide)
        first, end = views.count, views.count + count
        scene = _Scene.of(
            bells.values[:, :, :times].contiguous(),
            scale[:, :times],
            seen.at[:, :times, first:end],
            seen.behind[:, :times, first:end],
            shares,
        )
        last = slice(first, first + own.shape[1])
        lit, light = _Own.of(
            bells.values[:, :, times:],
            scale[:, times:],
            seen.behind[:, times:, :first],
            seen.at[:, times:, last],
            seen.behind[:, times:, last],
        )
        ctx.parts = views, seen, bells, scene, lit
        ctx.save_for_backward(widths, light)
        return scene.all, light

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        views, seen, bells, scene, lit = ctx.parts
        widths, light = ctx.saved_tensors
        slopes, own = scene.backward(upstream[0]), lit.backward(upstream[1], light)
        times, most = slopes.at.shape[1], seen.at.shape[2] - views.count
        by_cast, by_wide = bells.backward(
            torch.cat([slopes.across, own.across], 1), torch.cat([slopes.down, own.down], 1)
        )
        by_at = torch.cat([_padded(slopes.at, most), _padded(own.at, most)], 1)
        behind = F.pad(slopes.behind, (views.count, most - slopes.behind.shape[2]))
        own_behind = F.pad(own.behind, (0, seen.at.shape[2] - own.behind.shape[2]))
        by_lamps, by_body, by_places = views.backward(
            seen, torch.cat([by_cast, by_at], 2), torch.cat([behind, own_behind], 1)
        )
        by_widths = [
            slopes.of_width(by_wide[:, :times].sum(1), widths[0]),
            own.of_width(by_wide[:, times:].sum(1), widths[1]),
        ]
        return (
            by_body[:times],
            by_places[:times, : slopes.at.shape[2]].sum(0),
            None,
            by_lamps,
            torch.stack(by_widths),
            slopes.share,
            None,
        )


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Gradients of what a shadow was made of."""

    across: Float[Tensor, "L T C P"]
    down: Float[Tensor, "L T C P"]
    """Of the bells."""
    density: Float[Tensor, "L"]
    """Of a factor on the densities."""
    at: Float[Tensor, "L T N 2"]
    behind: Float[Tensor, "L T *N"]
    """Of places, or of the body's points and then places."""
    share: Float[Tensor, "L"] | None = None

    def of_width(self, by_width: Float[Tensor, "L"], widths: Float[Tensor, "L"]) -> Tensor:
        """That of the widths with what `_scale` adds to that of the bells."""
        return torch.addcdiv(by_width, self.density, widths, value=-2)


@dataclass(frozen=True, eq=False)
class _Scene:
    """Shadows on places behind the body."""

    bells: Float[Tensor, "2 L T C P"]
    scale: Float[Tensor, "L #T 1 1"]
    density: Float[Tensor, "L T C C"]
    """Negative, as light is its exponential."""
    grid: Tensor
    shares: Float[Tensor, "L 1 1"]
    sampled: Float[Tensor, "L T N"]
    gate: Float[Tensor, "L T N"]
    passed: Float[Tensor, "L T N"]
    """The share of each lamp's light that the body lets through."""
    factors: Float[Tensor, "L T N"]
    """Of each lamp."""
    all: Float[Tensor, "T N"]
    """Their product."""

    @classmethod
    def of(
        cls, bells: Tensor, scale: Tensor, at: Tensor, behind: Tensor, shares: Tensor
    ) -> "_Scene":
        density = scale * (bells[1] @ bells[0].mT)
        grid = (at / REACH_M).flatten(0, 1)[:, None]
        sampled = _sample(density.flatten(0, 1)[:, None], grid).view(behind.shape)
        edge = constant((-_BEHIND_M / _BEHIND_EDGE_M,), behind)
        gate = torch.sigmoid(torch.add(edge, behind, alpha=1 / _BEHIND_EDGE_M))
        passed, wide = torch.exp(sampled * gate), shares.detach()[:, None, None]
        factors = torch.lerp(constant((1.0,), passed), passed, wide)
        each = bells, scale, density, grid, wide, sampled, gate, passed
        return cls(*each, factors, factors.prod(0))

    def backward(self, above: Float[Tensor, "T N"]) -> _Slopes:
        tiny = torch.finfo(self.factors.dtype).tiny
        by_factor = above * self.all / self.factors.clamp_min(tiny)
        by_log = by_factor * self.passed
        by_depth = by_log * self.shares
        by_gate = _sigmoid_slope(by_depth * self.sampled, self.gate) / _BEHIND_EDGE_M
        grids = self.density.flatten(0, 1)[:, None]
        by_density, by_at = _sample_backward(by_depth * self.gate, grids, self.grid)
        by_density = by_density.view_as(self.density)
        scaled = self.scale * by_density
        return _Slopes(
            scaled.mT @ self.bells[1],
            scaled @ self.bells[0],
            (by_density * self.density).sum((1, 2, 3)),
            (by_at / REACH_M).view(*by_gate.shape, 2),
            by_gate,
            (by_log - by_factor).sum((1, 2)),
        )


@dataclass(frozen=True, eq=False)
class _Own:
    """Light on places of the body itself, by layers along it each of which holds what is nearer."""

    bells: Float[Tensor, "2 L T C P"]
    scale: Float[Tensor, "L #T 1 1"]
    density: Float[Tensor, "L T Z*C C"]
    """Negative, as light is its exponential."""
    grid: Tensor
    nearer: Float[Tensor, "L T Z P"]
    rows: Float[Tensor, "L T Z*C P"]

    @classmethod
    def of(
        cls, bells: Tensor, scale: Tensor, in_front: Tensor, at: Tensor, behind: Tensor
    ) -> tuple["_Own", Float[Tensor, "L T N"]]:
        layers = constant([place / _LAYER_EDGE_M for place in evenly(_LAYERS)], in_front)[:, None]
        nearer = torch.sigmoid(torch.sub(layers, in_front[:, :, None], alpha=1 / _LAYER_EDGE_M))
        rows = (nearer[:, :, :, None] * bells[1][:, :, None]).flatten(2, 3)
        density = scale * (rows @ bells[0].mT)
        where, surface = torch.cat([at, behind[..., None]], -1), -_OWN_SURFACE_M / REACH_M
        grid = torch.add(constant((0.0, 0.0, surface), where), where, alpha=1 / REACH_M)
        grid = grid.flatten(0, 1)[:, None, None]
        depth = _sample(density.flatten(0, 1).unflatten(1, (1, _LAYERS, CELLS)), grid)
        light = torch.exp(depth.view(behind.shape))
        return cls(bells, scale, density, grid, nearer, rows), light

    def backward(self, above: Float[Tensor, "L T N"], light: Tensor) -> _Slopes:
        layered = self.density.flatten(0, 1).unflatten(1, (1, _LAYERS, CELLS))
        by_density, by_where = _sample_backward(above * light, layered, self.grid)
        by_density = by_density.view_as(self.density)
        by_where = by_where.view(*light.shape, 3) / REACH_M
        scaled = self.scale * by_density
        by_rows = (scaled @ self.bells[0]).unflatten(2, (_LAYERS, CELLS))
        by_nearer = (by_rows * self.bells[1][:, :, None]).sum(3)
        by_front = _sigmoid_slope(by_nearer, self.nearer).sum(2) * (-1 / _LAYER_EDGE_M)
        return _Slopes(
            scaled.mT @ self.rows,
            (by_rows * self.nearer[:, :, :, None]).sum(2),
            (by_density * self.density).sum((1, 2, 3)),
            by_where[..., :2],
            torch.cat([by_front, by_where[..., 2]], 2),
        )


def _padded(places: Float[Tensor, "*T N D"], count: int) -> Float[Tensor, "*T M D"]:
    """With zeros up to so many places."""
    missing = count - places.shape[-2]
    return F.pad(places, (0, 0, 0, missing)) if missing else places


def _scale(
    body: Float[Tensor, "T P 3"], widths: Float[Tensor, "L #T"]
) -> Float[Tensor, "L #T 1 1"]:
    scale = -DENSITY * AREA_M2 / (body.shape[1] * 2 * torch.pi)
    return (scale * widths.pow(-2))[..., None, None]


def _sample(
    grids: Float[Tensor, "M 1 *cells"], at: Float[Tensor, "M *one N D"]
) -> Float[Tensor, "M *one N"]:
    """Values of the grids at places in [-1, 1], of which the last axis comes first."""
    return F.grid_sample(grids, at, align_corners=True)


def _sample_backward(above: Tensor, grids: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of grids and places."""
    flat = grids.dim() == 4
    run = (
        torch.ops.aten.grid_sampler_2d_backward if flat else torch.ops.aten.grid_sampler_3d_backward
    )
    above = above.reshape(len(grids), 1, *at.shape[1:-1]).contiguous()
    by_grids, by_at = run(above, grids, at, 0, 0, True, [True, True])
    return by_grids, by_at
