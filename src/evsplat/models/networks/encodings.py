"""Position encodings: smooth one-blob and multi-resolution hash grid."""

import math
from importlib.util import find_spec
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native

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
        if runs_native(positions):
            encoded: Tensor = _NativeOneBlob.apply(positions, self.bins)
            return encoded
        scaled = positions.clamp(0, 1) * self.bins
        cell = scaled.detach().floor().clamp_max(self.bins - 1)
        # The bump's centre lies in `cell`, its ends in the two neighbours: three bins are not zero.
        below = _quartic_cdf(cell - scaled)
        upto = _quartic_cdf(cell + 1 - scaled)
        shares = torch.stack((below, upto - below, 1 - upto), -1)
        index = cell.long()[..., None] + torch.arange(-1, 2, device=cell.device)
        empty = shares.new_zeros(*positions.shape, self.bins)
        return empty.scatter(-1, index % self.bins, shares).flatten(-2)


class _NativeOneBlob(torch.autograd.Function):
    """`OneBlobEncoding` in the compiled module."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, bins: int) -> Float[Tensor, "*batch D"]:
        given = positions.detach().contiguous()
        encoded = torch.empty(*positions.shape[:-1], positions.shape[-1] * bins)
        native.one_blob(given, bins, encoded, torch.get_num_threads())
        ctx.bins = bins
        ctx.save_for_backward(given)
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (positions,) = ctx.saved_tensors
        gradient = torch.empty_like(positions)
        above = upstream[0].contiguous()
        native.one_blob_backward(positions, ctx.bins, above, gradient, torch.get_num_threads())
        return gradient, None


class HashGridEncoding(nn.Module):
    """Multi-resolution hash grid (Instant-NGP), trilinear, gradients to table and positions.

    Defaults as configured for the non-rigid network of 3DGS-Avatar (method.md 1.5): 16 levels of 2
    features, tables of 2^16, resolutions 16 to 2048. Level l has ``floor(base b^l)`` cells per
    axis; it is stored densely while its vertices fit in the table, and hashed from there on.
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
        layout = [
            (cells, start, size == (cells + 1) ** 3)
            for cells, start, size in zip(self.resolutions, self.offsets, sizes, strict=False)
        ]
        self.layout: Tensor
        self.register_buffer("layout", torch.tensor(layout, dtype=torch.int32), persistent=False)

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions in [0, 1]."""
        clamped = positions.clamp(0, 1).reshape(-1, 3)
        encoded: Tensor
        if _runs_triton(clamped):
            from evsplat.deform.hash_grid_triton import TritonLookup

            encoded = TritonLookup.apply(clamped, self.table, self.layout, self.table_mask)
        else:
            lookup = _NativeLookup if runs_native(clamped) else _TorchLookup
            encoded = lookup.apply(clamped, self.table, self)
        return encoded.T.unflatten(0, positions.shape[:-1])

    def cell(
        self, positions: Float[Tensor, "3 N"], level: int
    ) -> tuple[Int[Tensor, "2 2 2 N"], Float[Tensor, "3 N"]]:
        """Table entries of the eight corners (x, y, z) of each position's cell, and place in it."""
        cells = self.resolutions[level]
        scaled = positions * cells
        corner = scaled.floor().clamp_max_(cells - 1)
        low = corner.long()
        dense = self.offsets[level + 1] - self.offsets[level] == (cells + 1) ** 3
        strides = (1, cells + 1, (cells + 1) ** 2) if dense else _HASH_PRIMES
        x, y, z = (
            torch.stack((axis, axis + 1)).mul_(stride)
            for axis, stride in zip(low, strides, strict=True)
        )
        x, y = x[:, None, None], y[:, None]
        entries = x + (y + z) if dense else (x ^ (y ^ z)).bitwise_and_(self.table_mask)
        return entries.add_(self.offsets[level]), scaled.sub_(corner)


def _runs_triton(tensor: Tensor) -> bool:
    """Whether Triton, which comes with PyTorch's CUDA builds for Linux, takes this tensor."""
    on_gpu = tensor.device.type == "cuda" and tensor.dtype == torch.float32
    return on_gpu and find_spec("triton") is not None


class _NativeLookup(torch.autograd.Function):
    """In the compiled module, one thread per level; sums into the table keep their order."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, grid: HashGridEncoding
    ) -> Float[Tensor, "D N"]:
        layout = list(grid.resolutions), list(grid.offsets), grid.table_mask
        encoded = torch.empty(grid.dim, len(positions))
        positions = positions.contiguous()
        native.hash_encode(
            positions.detach(), table.detach(), *layout, encoded, torch.get_num_threads()
        )
        ctx.layout = layout
        ctx.save_for_backward(positions, table)
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        positions, table = (tensor.detach() for tensor in ctx.saved_tensors)
        need_positions, need_table = ctx.needs_input_grad[:2]
        table_gradient = torch.zeros_like(table) if need_table else None
        position_gradient = torch.empty_like(positions) if need_positions else None
        native.hash_encode_backward(
            positions, table, *ctx.layout, upstream[0].contiguous(),
            table_gradient, position_gradient, torch.get_num_threads(),
        )  # fmt: skip
        return position_gradient, table_gradient, None


class _TorchLookup(torch.autograd.Function):
    """Per level: gather the eight corners and blend. Points are the last axis, for speed."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, grid: HashGridEncoding
    ) -> Float[Tensor, "D N"]:
        transposed = positions.T.contiguous()
        encoded = positions.new_empty(grid.dim, len(positions))
        cells = [grid.cell(transposed, level) for level in range(len(grid.resolutions))]
        # One row per feature: gathers and sums then run along contiguous memory.
        features = table.T.contiguous()
        rows = iter(encoded)
        for entries, inside in cells:
            shares = _corner_shares(inside)
            for feature in features:
                corners = feature.index_select(0, entries.view(-1)).view_as(shares)
                torch.sum(corners.mul_(shares).flatten(0, 2), 0, out=next(rows))
        ctx.cells = cells
        ctx.save_for_backward(features)
        ctx.resolutions = grid.resolutions
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        (features,) = ctx.saved_tensors
        need_positions, need_table = ctx.needs_input_grad[:2]
        table_gradient = torch.zeros_like(features) if need_table else None
        position_gradient = torch.zeros_like(ctx.cells[0][1]) if need_positions else None
        by_level = gradients[0].contiguous().split(len(features))
        for (entries, inside), cells, gradient in zip(
            ctx.cells, ctx.resolutions, by_level, strict=True
        ):
            flat = entries.view(-1)
            if table_gradient is not None:
                shares = _corner_shares(inside)
                for row, step in zip(table_gradient, gradient, strict=True):
                    row.scatter_add_(0, flat, (shares * step).view(-1))
            if position_gradient is not None:
                pull = torch.zeros_like(entries, dtype=features.dtype)
                for feature, step in zip(features, gradient, strict=True):
                    pull.addcmul_(feature.index_select(0, flat).view_as(pull), step)
                position_gradient += cells * _blend_slopes(pull, inside)
        return (
            None if position_gradient is None else position_gradient.T,
            None if table_gradient is None else table_gradient.T,
            None,
        )


def _corner_shares(inside: Float[Tensor, "3 N"]) -> Float[Tensor, "2 2 2 N"]:
    """Trilinear weights of the corners of a cell."""
    x, y, z = torch.stack((1 - inside, inside), 1)
    return x[:, None, None] * (y[:, None] * z)


def _blend_slopes(
    corners: Float[Tensor, "2 2 2 N"], inside: Float[Tensor, "3 N"]
) -> Float[Tensor, "3 N"]:
    """Derivatives of the trilinear blend of ``corners`` along x, y, z of the cell."""
    x, y, z = inside
    along_z = corners[:, :, 1] - corners[:, :, 0]
    at_z = torch.addcmul(corners[:, :, 0], z, along_z)
    along_y = at_z[:, 1] - at_z[:, 0]
    at_yz = torch.addcmul(at_z[:, 0], y, along_y)
    slope_z = torch.lerp(along_z[:, 0], along_z[:, 1], y)
    return torch.stack(
        (
            at_yz[1] - at_yz[0],
            torch.lerp(along_y[0], along_y[1], x),
            torch.lerp(slope_z[0], slope_z[1], x),
        )
    )


def _quartic_cdf(u: Tensor) -> Tensor:
    """Integral from -1 to u of ``15/16 (1 - v^2)^2``, for u in [-1, 1]."""
    square = u * u
    return 0.5 + u * (0.9375 + square * (0.1875 * square - 0.625))
