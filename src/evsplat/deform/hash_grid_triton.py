"""The hash grid of `evsplat.deform.encodings` as Triton kernels, for tensors on a GPU.

Sums into the table are atomic: two runs agree up to rounding, not bit for bit.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

_POINTS = 128
"""Points per program; a program takes one level."""

# The primes of Instant-NGP as signed 32-bit numbers: the table's index is the low bits of a
# product, which wraps alike.
_PRIME_Y = tl.constexpr(2_654_435_761 - 2**32)
_PRIME_Z = tl.constexpr(805_459_861)


@triton.jit
def _cell(positions, layout, point, inside, level, count):
    """Lowest corner of each point's cell, the place in it, and what the level is like."""
    cells = tl.load(layout + 3 * level)
    start = tl.load(layout + 3 * level + 1)
    dense = tl.load(layout + 3 * level + 2)
    last = (cells - 1).to(tl.float32)
    x = tl.load(positions + 3 * point, mask=inside, other=0.0) * cells
    y = tl.load(positions + 3 * point + 1, mask=inside, other=0.0) * cells
    z = tl.load(positions + 3 * point + 2, mask=inside, other=0.0) * cells
    # The maximum of NaN and 0 is 0: a position that is no number stays inside the table.
    low_x = tl.minimum(tl.maximum(tl.floor(x), 0.0), last)
    low_y = tl.minimum(tl.maximum(tl.floor(y), 0.0), last)
    low_z = tl.minimum(tl.maximum(tl.floor(z), 0.0), last)
    return (
        low_x.to(tl.int32),
        low_y.to(tl.int32),
        low_z.to(tl.int32),
        x - low_x,
        y - low_y,
        z - low_z,
        cells,
        start,
        dense,
    )


@triton.jit
def _entry(x, y, z, cells, start, dense, mask):
    """Row of the table of a vertex."""
    side = cells + 1
    direct = x + side * (y + side * z)
    hashed = (x ^ (y * _PRIME_Y) ^ (z * _PRIME_Z)) & mask
    return start + tl.where(dense != 0, direct, hashed)


@triton.jit
def _encode(
    positions, table, layout, encoded, count, mask, FEATURES: tl.constexpr, POINTS: tl.constexpr
):
    level = tl.program_id(1)
    point = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    there = point < count
    x, y, z, u, v, w, cells, start, dense = _cell(positions, layout, point, there, level, count)
    for feature in tl.static_range(FEATURES):
        total = tl.full((POINTS,), 0.0, tl.float32)
        for corner in tl.static_range(8):
            i = corner & 1
            j = (corner >> 1) & 1
            k = corner >> 2
            row = _entry(x + i, y + j, z + k, cells, start, dense, mask)
            share = (u if i else 1 - u) * ((v if j else 1 - v) * (w if k else 1 - w))
            total += share * tl.load(table + row * FEATURES + feature, mask=there, other=0.0)
        tl.store(encoded + (level * FEATURES + feature) * count + point, total, mask=there)


@triton.jit
def _encode_backward(
    positions,
    table,
    layout,
    upstream,
    table_gradient,
    position_gradient,
    count,
    mask,
    FEATURES: tl.constexpr,
    POINTS: tl.constexpr,
    OF_TABLE: tl.constexpr,
    OF_POSITIONS: tl.constexpr,
):
    level = tl.program_id(1)
    point = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    there = point < count
    x, y, z, u, v, w, cells, start, dense = _cell(positions, layout, point, there, level, count)
    along_x = tl.full((POINTS,), 0.0, tl.float32)
    along_y = tl.full((POINTS,), 0.0, tl.float32)
    along_z = tl.full((POINTS,), 0.0, tl.float32)
    for feature in tl.static_range(FEATURES):
        place = upstream + (level * FEATURES + feature) * count + point
        pull = tl.load(place, mask=there, other=0.0)
        for corner in tl.static_range(8):
            i = corner & 1
            j = (corner >> 1) & 1
            k = corner >> 2
            row = _entry(x + i, y + j, z + k, cells, start, dense, mask)
            a = u if i else 1 - u
            b = v if j else 1 - v
            c = w if k else 1 - w
            if OF_TABLE:
                where = table_gradient + row * FEATURES + feature
                tl.atomic_add(where, a * (b * c) * pull, mask=there, sem="relaxed")
            if OF_POSITIONS:
                value = pull * tl.load(table + row * FEATURES + feature, mask=there, other=0.0)
                along_x += (b * c * value) if i else -(b * c * value)
                along_y += (a * c * value) if j else -(a * c * value)
                along_z += (a * b * value) if k else -(a * b * value)
    if OF_POSITIONS:
        tl.atomic_add(position_gradient + 3 * point, along_x * cells, mask=there, sem="relaxed")
        tl.atomic_add(position_gradient + 3 * point + 1, along_y * cells, mask=there, sem="relaxed")
        tl.atomic_add(position_gradient + 3 * point + 2, along_z * cells, mask=there, sem="relaxed")


class TritonLookup(torch.autograd.Function):
    """Encoded (D, N) of positions (N, 3) in [0, 1], gradients to positions and table."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Float[Tensor, "N 3"],
        table: Float[Tensor, "R F"],
        layout: Int[Tensor, "L 3"],
        mask: int,
    ) -> Float[Tensor, "D N"]:
        """``layout``: cells per axis, first row and whether dense, of each level, int32."""
        positions, features = positions.contiguous(), table.shape[1]
        encoded = positions.new_empty(len(layout) * features, len(positions))
        if len(positions):
            _encode[_programs(positions, layout)](
                positions, table, layout, encoded, len(positions), mask, features, _POINTS
            )
        ctx.mask = mask
        ctx.save_for_backward(positions, table, layout)
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        """Of all that needs one."""
        positions, table, layout = ctx.saved_tensors
        of_positions, of_table = ctx.needs_input_grad[:2]
        position_gradient, table_gradient = torch.zeros_like(positions), torch.zeros_like(table)
        if len(positions):
            _encode_backward[_programs(positions, layout)](
                positions, table, layout, upstream[0].contiguous(),
                table_gradient, position_gradient, len(positions), ctx.mask,
                table.shape[1], _POINTS, of_table, of_positions,
            )  # fmt: skip
        return (
            position_gradient if of_positions else None,
            table_gradient if of_table else None,
            None,
            None,
        )


def _programs(positions: Tensor, layout: Tensor) -> tuple[int, int]:
    return triton.cdiv(len(positions), _POINTS), len(layout)
