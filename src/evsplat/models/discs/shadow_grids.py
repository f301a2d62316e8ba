"""Shadows of points in the light of lamps, by grids of round Gaussians that lie across the light.

From a lamp each point of the body is a round Gaussian on the plane through the body's middle that
faces the lamp. A sum of those on a grid is a product of two matrices; the compiled module adds each
to the cells that it reaches.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native
from evsplat.models.discs.plain_shadow import (
    AREA_M2,
    DENSITY,
    light_on_places,
    shadow_and_light,
    shadow_on_places,
)

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
    compiled = _all_native(body, lamps, widths, shares) and runs_native(places)
    shade = _Cast.apply if compiled else shadow_on_places
    factors: Tensor = shade(body, places.flatten(0, 1), lamps, widths, shares)
    return factors.unflatten(1, places.shape[:2])


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
    return light_on_places(body, places, lamps, widths)


def both_shadows(
    body: Float[Tensor, "T P 3"],
    places: Float[Tensor, "H W 3"],
    own: Float[Tensor, "K N 3"],
    lamps: Float[Tensor, "L 3"],
    widths: Float[Tensor, "2 L"],
    shares: Float[Tensor, "L"],
    at: slice,
) -> tuple[Float[Tensor, "T H W"], Float[Tensor, "L K N"]]:
    """`shadow_on_scene`, and `light_on_body` at its ``own`` places at the times ``at``.

    ``widths``: of the former and of the latter. The latter moves neither the body nor its places.
    """
    own = own.detach()
    if native is not None and body.device.type == "cpu":
        scene, person = widths
        light = light_on_body(body[at].detach(), own, lamps, person)
        return shadow_on_scene(body, places, lamps, scene, shares), light
    factors, light = shadow_and_light(body, places.flatten(0, 1), own, lamps, widths, shares, at)
    return factors.unflatten(1, places.shape[:2]), light


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
        strength = DENSITY * AREA_M2 / (body.shape[1] * 2 * torch.pi)
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
