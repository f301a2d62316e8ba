"""How far drawings of a person are from the pictures that they should be."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native
from evsplat.posing.targets import Looked, Targets
from evsplat.render import RenderOutput

_MISFIT = 0.06
"""Difference of coded colours from which on more of it counts little."""


def misfits(drawn: RenderOutput, targets: Targets) -> Float[Tensor, "P"]:
    """Of each picture, of drawings before nothing: sums over the pixels by their weights.

    Differences are Cauchy-distributed: colours ``d`` apart cost ``log(1 + |d|^2 / (2 m^2))``.
    """
    looked, planes = targets.looked, drawn.image.permute(0, 3, 1, 2)
    colours = targets.greyed(_colours(planes, drawn.alpha, looked), looked.grey)
    if runs_native(colours):
        found: Tensor = _NativeMisfit.apply(colours, looked)
        return found
    apart = (colours - looked.image).square().sum(-1)
    unlikely = torch.log1p(apart / (2 * _MISFIT**2)) * looked.weight
    return torch.stack([one.sum() for one in unlikely.split(looked.counts.tolist())])


def _colours(
    planes: Float[Tensor, "P 3 H W"], alpha: Float[Tensor, "P H W"], looked: Looked
) -> Float[Tensor, "N 3"]:
    """Of the pixels that are looked at, before what is behind the person."""
    if runs_native(planes):
        found: Tensor = _NativeColours.apply(planes, alpha, looked)
        return found
    place = looked.place
    shown = planes.movedim(1, -1).flatten(0, 2)[place]
    return shown + (1 - alpha.flatten()[place])[:, None] * looked.behind


class _NativeColours(torch.autograd.Function):
    """`_colours` in the compiled module."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, alpha: Tensor, looked: Looked) -> Tensor:
        ctx.looked, ctx.threads = looked, torch.get_num_threads()
        ctx.shapes = planes.shape, alpha.shape
        given = planes.detach().contiguous(), alpha.detach().contiguous()
        colours = torch.empty_like(looked.behind)
        at = looked.pixel, looked.ends, looked.behind
        native.colours_before(*given, *at, colours, ctx.threads)
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor, None]:
        looked, above = ctx.looked, upstream[0].contiguous()
        by_planes, by_alpha = (above.new_empty(shape) for shape in ctx.shapes)
        at = looked.pixel, looked.ends, looked.behind
        native.colours_before_backward(*at, above, by_planes, by_alpha, ctx.threads)
        return by_planes, by_alpha, None


class _NativeMisfit(torch.autograd.Function):
    """Sums of each picture in the compiled module, which finds the slopes with them."""

    @staticmethod
    def forward(ctx: Any, colours: Tensor, looked: Looked) -> Tensor:
        given = colours.detach().contiguous()
        slope = torch.empty_like(given) if ctx.needs_input_grad[0] else None
        ctx.looked = looked
        ctx.save_for_backward(slope)
        sums = given.new_empty(len(looked.counts))
        pictures = looked.ends, looked.image, looked.weight
        scale = 1 / (2 * _MISFIT**2)
        native.misfit(given, *pictures, scale, slope, sums, torch.get_num_threads())
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        each = upstream[0].repeat_interleave(ctx.looked.counts)
        return ctx.saved_tensors[0] * each[:, None], None
