"""Shadows of points in the light of lamps, by grids of round Gaussians that lie across the light.

From a lamp each point of the body is a round Gaussian on the plane through the body's middle that
faces the lamp. A sum of those on a grid is a product of two matrices; the compiled module adds each
to the cells that it reaches.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native

_REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
_CELLS = 49
_LAYERS = 31
"""Of the space around the body along the light, in which it shades itself."""
_LAYER_EDGE_M = 0.03
_OWN_SURFACE_M = 0.12
"""How far nearer to the lamp a part of the body must be to shade another."""
_NEAREST_M = 0.1
_DENSITY = 3.0
"""Optical depth through the middle of a body that covers `_AREA_M2` across the light."""
_AREA_M2 = 0.5
_MOST_LAMPS = 16
"""That the compiled module takes."""


def shadow_on_scene(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "H W 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "L"],
    shares: Float[Tensor, "L"],
) -> Float[Tensor, "T H W"]:
    """Factors in 0..1 on the light at the scene's ``places``.

    A lamp's ``shares`` of the light, in 0..1, gets lost times ``1 - exp(-depth)`` behind the points
    of the ``body``, Gaussians of standard deviation ``widths`` (metres).
    """
    if _all_native(body, lamps, widths, shares) and runs_native(places):
        factors: Tensor = _Cast.apply(body, places.flatten(0, 1), lamps, widths, shares)
        return factors.unflatten(1, places.shape[:2])
    views = _LampViews.of(lamps, body)
    across, down = _bells(views.project(body)[0], widths)
    density = _scale(body, widths) * across @ down.transpose(-1, -2)
    at, behind = views.project(places.flatten(0, 1)[None])
    # grid_sample wants the coordinate along the last axis first.
    sampled = nn.functional.grid_sample(
        density.flatten(0, 1)[:, None],
        at.flatten(0, 1)[:, None].flip(-1) / _REACH_M,
        align_corners=True,
    )
    depth = sampled.view(behind.shape) * torch.sigmoid((behind + 0.2) / 0.1)
    factor = 1 - shares[:, None, None] * (1 - torch.exp(-depth))
    return factor.prod(0).unflatten(1, places.shape[:2])


def light_on_body(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "T N 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "L"],
) -> Float[Tensor, "L T N"]:
    """Share of each lamp's light, in 0..1, that points of the body leave to places on itself.

    Only points that are nearer to the lamp count: in layers along the light, each of which holds
    what is nearer.
    """
    if _all_native(lamps, widths) and _fixed(body) and _fixed(places):
        light: Tensor = _Cast.apply(body, places, lamps, widths, None)
        return light
    views = _LampViews.of(lamps, body)
    at, behind = views.project(body)
    layers = torch.linspace(-_REACH_M, _REACH_M, _LAYERS, dtype=lamps.dtype, device=lamps.device)
    nearer = torch.sigmoid((layers[:, None] - behind[:, :, None]) / _LAYER_EDGE_M)
    across, down = _bells(at, widths)
    rows = (nearer[:, :, :, None] * across[:, :, None]).flatten(2, 3)
    density = _scale(body, widths) * rows @ down.transpose(-1, -2)
    at, behind = views.project(places)
    seen = torch.cat([at.flip(-1), (behind - _OWN_SURFACE_M)[..., None]], -1)
    depth = nn.functional.grid_sample(
        density.flatten(0, 1).unflatten(1, (1, _LAYERS, _CELLS)),
        seen.flatten(0, 1)[:, None, None] / _REACH_M,
        align_corners=True,
    )
    return torch.exp(-depth.view(behind.shape))


def _all_native(*tensors: Tensor) -> bool:
    return all(map(runs_native, tensors)) and len(tensors[-1]) <= _MOST_LAMPS


def _fixed(tensor: Tensor) -> bool:
    """Whether the compiled module takes it: it has no gradient of these."""
    return runs_native(tensor) and not (tensor.requires_grad and torch.is_grad_enabled())


class _Cast(torch.autograd.Function):
    """Both in the compiled module: without ``shares`` it is the light on the body."""

    @staticmethod
    def forward(
        ctx: Any,
        body: Tensor,
        places: Tensor,
        lamps: Tensor,
        widths: Tensor,
        shares: Tensor | None,
    ) -> Tensor:
        given = [
            None if tensor is None else tensor.detach().contiguous()
            for tensor in (body, places, lamps, widths, shares)
        ]
        count, times, layered = len(lamps), len(body), shares is None
        strength = _DENSITY * _AREA_M2 / (body.shape[1] * 2 * torch.pi)
        grids = body.new_empty(count, times, native.shadow_grid(layered))
        size = (count, times, places.shape[1]) if layered else (times, len(places))
        result = body.new_empty(size)
        native.cast_shadow(*given, strength, grids, result, torch.get_num_threads())
        ctx.strength = strength
        ctx.save_for_backward(*given, grids)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        *given, grids = ctx.saved_tensors
        body, places, lamps, widths, shares = given
        to_body = torch.empty_like(body) if ctx.needs_input_grad[0] else None
        to_places = torch.empty_like(places) if ctx.needs_input_grad[1] else None
        to_shares = None if shares is None else torch.empty_like(shares)
        to_lamps, to_widths = torch.empty_like(lamps), torch.empty_like(widths)
        native.cast_shadow_backward(
            *given,
            ctx.strength,
            grids,
            upstream[0].contiguous(),
            to_body,
            to_places,
            to_lamps,
            to_widths,
            to_shares,
            torch.get_num_threads(),
        )
        return to_body, to_places, to_lamps, to_widths, to_shares


@dataclass(frozen=True, eq=False)
class _LampViews:
    """Views of the lamps: the planes through the body's middle that face them."""

    lamps: Float[Tensor, "L 3"]
    axis: Float[Tensor, "L T 3"]
    across: Float[Tensor, "L T 2 3"]
    distance: Float[Tensor, "L T"]

    @classmethod
    def of(cls, lamps: Float[Tensor, "L 3"], body: Float[Tensor, "T P 3"]) -> "_LampViews":
        ray = body.mean(1) - lamps[:, None]
        distance = ray.norm(dim=-1)
        axis = ray / distance[..., None]
        return cls(lamps, axis, _across(axis), distance)

    def project(
        self, points: Float[Tensor, "#T N 3"]
    ) -> tuple[Float[Tensor, "L T N 2"], Float[Tensor, "L T N"]]:
        """Points on the plane, and how far behind it they are, metres."""
        rays = points - self.lamps[:, None, None]
        along = (rays @ self.axis[..., None])[..., 0]
        distance = self.distance[..., None]
        spread = distance / along.clamp_min(_NEAREST_M)
        at = (rays @ self.across.transpose(-1, -2)) * spread[..., None]
        return at, along - distance


def _bells(
    at: Float[Tensor, "L T P 2"], widths: Float[Tensor, "L"]
) -> tuple[Float[Tensor, "L T C P"], Float[Tensor, "L T C P"]]:
    """Round Gaussians at points of the plane, one factor per axis, at the cells of the grid."""
    grid = torch.linspace(-_REACH_M, _REACH_M, _CELLS, dtype=at.dtype, device=at.device)
    away = (grid[:, None, None] - at[:, :, None]) / widths[:, None, None, None, None]
    bells = torch.exp(-0.5 * away.square())
    return bells[..., 0], bells[..., 1]


def _scale(body: Float[Tensor, "T P 3"], widths: Float[Tensor, "L"]) -> Float[Tensor, "L 1 1 1"]:
    scale = _DENSITY * _AREA_M2 / (body.shape[1] * 2 * torch.pi * widths.square())
    return scale[:, None, None, None]


def _across(axis: Float[Tensor, "*T 3"]) -> Float[Tensor, "*T 2 3"]:
    """Two unit vectors at right angles to ``axis`` and each other (Duff et al. 2017, JCGT 6)."""
    x, y, z = axis.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z.detach())
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y], -1)], -2)
