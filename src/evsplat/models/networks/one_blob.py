"""Smooth one-blob encoding of positions."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native


class OneBlobEncoding(nn.Module):
    """A smooth bump per axis, integrated over equal bins; no parameters.

    The bump is the quartic kernel ``15/16 (1 - u^2)^2`` with a radius of one bin, and what falls
    off one end comes in at the other, so that each axis sums to one (tiny-cuda-nn's one-blob). The
    released 3DGS-Avatar asks for a hash grid and most likely gets this: 16 bins, 48 values
    (reference 1.5); the smooth one generalises better to held-out poses.
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


def _quartic_cdf(u: Tensor) -> Tensor:
    """Integral from -1 to u of ``15/16 (1 - v^2)^2``, for u in [-1, 1]."""
    square = u * u
    return 0.5 + u * (0.9375 + square * (0.1875 * square - 0.625))
