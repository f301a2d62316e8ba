"""Large pictures through a network in overlapping tiles."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

SIDE_PX = 512
"""Longest side of a tile; all the pictures that fit go through whole."""
OVERLAP_PX = 64


def in_tiles(
    network: Callable[..., Float[Tensor, "1 C h w"]],
    inputs: Sequence[Float[Tensor, "1 _ H W"]],
    *,
    multiple: int,
    side: int = SIDE_PX,
    overlap: int = OVERLAP_PX,
) -> Float[Tensor, "1 C H W"]:
    """``network(*inputs)``, tile by tile where the pictures are larger than ``side``.

    Each tile is padded to sides that are a multiple of ``multiple`` by repeating its border, and
    neighbours are blended linearly over their overlap.
    """
    height, width = inputs[0].shape[-2:]
    total: Tensor | None = None
    share = torch.zeros(height, width, device=inputs[0].device)
    for top in _starts(height, side, overlap):
        for left in _starts(width, side, overlap):
            place = (..., slice(top, top + side), slice(left, left + side))
            parts = [part[place] for part in inputs]
            h, w = parts[0].shape[-2:]
            padding = (0, -w % multiple, 0, -h % multiple)
            made = network(*(F.pad(part, padding, mode="replicate") for part in parts))[..., :h, :w]
            weight = _ramp(h, overlap).to(made)[:, None] * _ramp(w, overlap).to(made)
            if total is None:
                total = made.new_zeros((*made.shape[:-2], height, width))
            total[place] += weight * made
            share[place] += weight
    assert total is not None
    return total / share


def _starts(length: int, side: int, overlap: int) -> list[int]:
    """Where tiles begin, evenly spread and overlapping by at least ``overlap``."""
    if length <= side:
        return [0]
    count = -(-(length - overlap) // (side - overlap))
    return [round(i * (length - side) / (count - 1)) for i in range(count)]


def _ramp(length: int, overlap: int) -> Float[Tensor, "L"]:
    """Grows from the border inwards over ``overlap`` pixels, and is 1 further in."""
    at = torch.arange(1, length + 1)
    return torch.minimum(at, at.flip(0)).clamp_max(overlap + 1) / (overlap + 1)
