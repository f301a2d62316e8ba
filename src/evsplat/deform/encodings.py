"""Position encodings: smooth one-blob and multi-resolution hash grid, in plain torch."""

import math
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

_HASH_PRIMES = (1, 2_654_435_761, 805_459_861)
"""Instant-NGP (Mueller et al. 2022), eq. 4."""


class Encoding(Protocol):
    """What the networks need of an encoding: (..., 3) in [0, 1] -> (..., dim)."""

    dim: int

    def __call__(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions; beyond [0, 1] those of the nearest face are used."""
        ...


def make_encoding(kind: Literal["oneblob", "hashgrid"]) -> "OneBlobEncoding | HashGridEncoding":
    """The encoding of that name with the paper's sizes (method.md 1.5)."""
    if kind == "oneblob":
        return OneBlobEncoding()
    if kind == "hashgrid":
        return HashGridEncoding()
    raise ValueError(f"encoding '{kind}' is unknown; expected oneblob or hashgrid")


class OneBlobEncoding(nn.Module):
    """A smooth bump per axis, integrated over equal bins; no parameters.

    The bump is the quartic kernel ``15/16 (1 - u^2)^2`` with a radius of one bin, and what falls
    off one end comes in at the other, so that each axis sums to one (tiny-cuda-nn's one-blob). This
    is what the released 3DGS-Avatar most likely ran with: 16 bins, 48 values (method.md 1.5).
    """

    def __init__(self, bins: int = 16) -> None:
        super().__init__()
        if bins < 3:
            raise ValueError(f"bins is {bins}, expected at least 3: a bump touches three of them")
        self.bins = bins
        self.dim = 3 * bins

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions in [0, 1]."""
        scaled = positions.clamp(0, 1) * self.bins
        cell = scaled.detach().floor().clamp_max(self.bins - 1)
        # The bump's centre lies in `cell`, its ends in the two neighbours: three bins are not zero.
        below = _quartic_cdf(cell - scaled)
        upto = _quartic_cdf(cell + 1 - scaled)
        shares = torch.stack((below, upto - below, 1 - upto), -1)
        index = cell.long()[..., None] + torch.arange(-1, 2, device=cell.device)
        empty = shares.new_zeros(*positions.shape, self.bins)
        return empty.scatter(-1, index % self.bins, shares).flatten(-2)


class HashGridEncoding(nn.Module):
    """Multi-resolution hash grid (Instant-NGP), trilinear, gradients to table and positions.

    Defaults as configured for the non-rigid network of 3DGS-Avatar (method.md 1.5): 16 levels of 2
    features, tables of 2^16, resolutions 16 to 2048. Level l has ``floor(base b^l)`` cells per axis;
    it is stored densely while its vertices fit in the table, and hashed from there on.
    """

    def __init__(
        self,
        levels: int = 16,
        features: int = 2,
        log2_table: int = 16,
        base: int = 16,
        finest: int = 2048,
    ) -> None:
        super().__init__()
        self.features = features
        self.dim = levels * features
        growth = math.log(finest / base) / max(levels - 1, 1)
        # The nudge keeps 2048 from becoming floor(2047.999...).
        self.resolutions = tuple(
            math.floor(base * math.exp(growth * level) + 1e-6) for level in range(levels)
        )
        self.table_mask = 2**log2_table - 1
        sizes = [min((cells + 1) ** 3, 2**log2_table) for cells in self.resolutions]
        self.offsets = tuple(sum(sizes[:level]) for level in range(levels + 1))
        self.table = nn.Parameter(torch.empty(sum(sizes), features).uniform_(-1e-4, 1e-4))

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions in [0, 1]."""
        clamped = positions.clamp(0, 1).reshape(-1, 3)
        encoded: Tensor = _HashGridLookup.apply(clamped, self.table, self)
        return encoded.unflatten(0, positions.shape[:-1])

    def cell(
        self, positions: Float[Tensor, "N 3"], level: int
    ) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 3"]]:
        """Table rows of the eight corners around each position (x slowest), and place in the cell."""
        cells = self.resolutions[level]
        scaled = positions * cells
        corner = scaled.floor().clamp_max(cells - 1)
        low = corner.long()
        dense = self.offsets[level + 1] - self.offsets[level] == (cells + 1) ** 3
        strides = (1, cells + 1, (cells + 1) ** 2) if dense else _HASH_PRIMES
        x, y, z = (torch.stack((axis, axis + 1), -1) for axis in low.unbind(-1))
        x, y, z = x[:, :, None, None] * strides[0], y[:, None, :, None] * strides[1], z * strides[2]
        if dense:
            rows = x + y + z[:, None, None, :]
        else:
            rows = (x ^ y ^ z[:, None, None, :]) & self.table_mask
        return rows.flatten(1) + self.offsets[level], scaled - corner


class _HashGridLookup(torch.autograd.Function):
    """Per level: gather eight rows and blend. Level by level, so that indices stay in cache."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, grid: HashGridEncoding
    ) -> Float[Tensor, "N D"]:
        encoded = []
        ctx.cells = []
        for level in range(len(grid.resolutions)):
            rows, inside = grid.cell(positions, level)
            shares = _corner_shares(*_axis_shares(inside))
            encoded.append(
                nn.functional.embedding_bag(rows, table, per_sample_weights=shares, mode="sum")
            )
            ctx.cells.append((rows, inside))
        ctx.save_for_backward(table)
        ctx.resolutions = grid.resolutions
        return torch.cat(encoded, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        (table,) = ctx.saved_tensors
        features = table.shape[1]
        place = torch.arange(features, device=table.device)
        table_gradient = torch.zeros_like(table).view(-1) if ctx.needs_input_grad[1] else None
        position_gradient = None
        by_level = gradients[0].split(features, -1)
        for (rows, inside), cells, gradient in zip(
            ctx.cells, ctx.resolutions, by_level, strict=True
        ):
            axes = _axis_shares(inside)
            if table_gradient is not None:
                flat = (rows[..., None] * features + place).view(-1)
                spread = _corner_shares(*axes)[..., None] * gradient[:, None, :]
                table_gradient.scatter_add_(0, flat, spread.view(-1))
            if ctx.needs_input_grad[0]:
                corners = table.index_select(0, rows.view(-1)).view(*rows.shape, features)
                pull = (corners * gradient[:, None, :]).sum(-1)
                slope = torch.stack(
                    [(pull * _corner_shares(*_replace(axes, axis))).sum(-1) for axis in range(3)], -1
                )
                step = slope * cells
                position_gradient = step if position_gradient is None else position_gradient + step
        shaped = None if table_gradient is None else table_gradient.view_as(table)
        return position_gradient, shaped, None


def _axis_shares(inside: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor, Tensor]:
    x, y, z = (torch.stack((1 - axis, axis), -1) for axis in inside.unbind(-1))
    return x, y, z


def _replace(axes: tuple[Tensor, Tensor, Tensor], axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """The shares with those of one axis replaced by their derivative, (-1, +1)."""
    slope = axes[axis].new_tensor([-1.0, 1.0]).expand_as(axes[axis])
    x, y, z = (slope if index == axis else share for index, share in enumerate(axes))
    return x, y, z


def _corner_shares(x: Tensor, y: Tensor, z: Tensor) -> Float[Tensor, "N 8"]:
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)


def _quartic_cdf(u: Tensor) -> Tensor:
    """Integral from -1 to u of ``15/16 (1 - v^2)^2``, for u in [-1, 1]."""
    square = u * u
    return 0.5 + u * (0.9375 + square * (0.1875 * square - 0.625))
