"""What is drawn, taken apart into the pictures that losses look at."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def split_channels(
    images: Float[Tensor, "T H W C"], sizes: Sequence[int]
) -> tuple[tuple[Float[Tensor, "H W c"], ...], ...]:
    """Per group of channels the pictures of all times, as views.

    Their gradients are put into one tensor, planar as the rasteriser's pictures are, in one pass.
    """
    parts = _SplitChannels.apply(images, tuple(sizes))
    times = len(images)
    return tuple(tuple(parts[k : k + times]) for k in range(0, len(parts), times))


class _SplitChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Tensor, sizes: tuple[int, ...]) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.sizes = images.shape, sizes
        return tuple(part[t] for part in images.split(sizes, -1) for t in range(len(images)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, None]:
        given = next((part for part in upstream if part is not None), None)
        if given is None:
            return None, None
        times, height, width, channels = ctx.shape
        gradient = given.new_empty(times, channels, height, width).permute(0, 2, 3, 1)
        parts = [part[t] for part in gradient.split(ctx.sizes, -1) for t in range(times)]
        for part, value in zip(parts, upstream, strict=True):
            part.zero_() if value is None else part.copy_(value)
        return gradient, None
