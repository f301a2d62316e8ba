"""Learned course of a turn per joint and of a shift of the root: a cubic B-spline in time."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from evsplat.devices import send

# Columns: the four pieces of a uniform cubic B-spline; rows: powers 0 to 3 of the place in between.
_PIECES = torch.tensor(
    [[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=torch.float64
) / 6  # fmt: skip

_REACH, _BLOCK = 14, 256
"""Keys that a piece of the spline through keys knows on either side; pieces made, and times
evaluated, at a time."""
_DENSE = 8 * _BLOCK
"""Control points up to which each time weighs all of them; of more only those near it."""


class PoseSpline(nn.Module):
    """Values ``w(t) . c`` with uniform knots; no units.

    Control points c, ``rotations`` (K, J, 3) and ``translations`` (K, 3), start at zero. Variants:

    - ``centred_us``: the mean over these times is zero. A constant and a canonical shape that is
      bent the other way look the same, and the shape follows all frames.
    - ``held_us``: zero at each of these times. Taken off is the cubic spline through its own values
      there; what is left is how it moves from one to the next.
    """

    rotations: Tensor
    translations: Tensor

    def __init__(
        self,
        span_us: tuple[int, int],
        knot_us: float,
        joints: int,
        *,
        centred_us: Sequence[int] = (),
        held_us: Sequence[int] = (),
        learned: bool = True,
    ) -> None:
        """Knots every ``knot_us`` from the start of ``span_us``; outside of it the ends are held.

        ``knot_us`` infinite: one value for all times. ``learned`` false: part of the state, but no
        parameter.
        """
        super().__init__()
        self.span_us, self.knot_us = span_us, float(knot_us)
        self.segments = max(1, math.ceil((span_us[1] - span_us[0]) / self.knot_us - 1e-9))
        self.count = 1 if math.isinf(knot_us) else self.segments + 3
        """Number of control points."""
        # No buffers: weights are found on the host, as each of their many small operations would
        # be a launch on a GPU.
        self.mean = torch.zeros(self.count)
        self.held = torch.zeros(0, 4, 0)
        self.held_first = torch.zeros(0, dtype=torch.long)
        self.held_s = torch.zeros(0, dtype=torch.float64)
        if len(held_us) > 1:
            self.held_s = 1e-6 * (torch.tensor(held_us, dtype=torch.float64) - span_us[0])
            self.held, self.held_first = self._through(held_us)
        elif len(centred_us) and not math.isinf(knot_us):
            self.mean = self._mean(torch.as_tensor(centred_us, dtype=torch.float64))
        starts = {
            "rotations": torch.zeros(self.count, joints, 3),
            "translations": torch.zeros(self.count, 3),
        }
        for name, value in starts.items():
            if learned:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def weights(self, times_us: Sequence[int] | Tensor) -> Float[Tensor, "T K"]:
        """Weights of the control points at given times, on the device of the control points."""
        device = self.rotations.device
        if math.isinf(self.knot_us):
            return torch.ones(len(times_us), 1, device=device)
        times = _on_host(times_us)
        found = torch.zeros(len(times), self.count, dtype=torch.float64)
        for index, share in self._local(times):
            found.scatter_add_(1, index, share)
        return send(found.float() - self.mean, device)

    def design(
        self, times_us: Sequence[int] | Tensor
    ) -> tuple[sparse.csr_array, Float[np.ndarray, "K"]]:
        """`weights` in two parts: of the control points near each time, and the mean taken off.

        Not of a spline that is held at keys.
        """
        if math.isinf(self.knot_us):
            return sparse.csr_array((len(times_us), 1)), -np.ones(1)  # 1 at all times
        ((index, share),) = self._local(_on_host(times_us))
        rows = np.arange(0, index.numel() + 1, index.shape[1])
        shape = len(times_us), self.count
        near = sparse.csr_array((share.flatten().numpy(), index.flatten().numpy(), rows), shape)
        return near, self.mean.double().numpy()

    def _local(self, times: Float[Tensor, "T"]) -> list[tuple[Tensor, Tensor]]:
        """Control points that count at each time, and their weights, of which there are two sorts.

        The mean is not taken off.
        """
        first, four = self._four(times)
        parts = [(first[:, None] + torch.arange(4), four)]
        if len(self.held):
            index, through = self._through_keys(times)
            parts.append((index, -through))
        return parts

    def _mean(self, times: Float[Tensor, "T"]) -> Float[Tensor, "K"]:
        """Mean weights, without a matrix of all times and control points."""
        total = torch.zeros(self.count, dtype=torch.float64)
        for index, share in self._local(times):
            total.index_add_(0, index.flatten(), share.flatten())
        return (total / len(times)).float()

    def _four(self, times: Float[Tensor, "T"]) -> tuple[Int[Tensor, "T"], Float[Tensor, "T 4"]]:
        """The first of the four control points that count at each time, and their weights."""
        place = (times.clamp(*self.span_us) - self.span_us[0]) / self.knot_us
        segment = place.floor().clamp(max=self.segments - 1)
        step = place - segment
        powers = torch.stack([torch.ones_like(step), step, step**2, step**3], 1)
        return segment.long(), powers @ _PIECES

    def _through(
        self, keys_us: Sequence[int]
    ) -> tuple[Float[Tensor, "P-1 4 B"], Int[Tensor, "P-1"]]:
        """Cubic splines through what the control points weigh at the keys, and the first of them.

        Per piece those of the `_REACH` keys before and after: farther ones count less than a
        rounding error, since a spline forgets three quarters of a value from one key to the next.
        So memory grows with the number of keys, not with its square: 1 kB a key.
        """
        index, four = self._four(torch.tensor(keys_us, dtype=torch.float64))
        first, seconds, pieces = index.numpy(), self.held_s.numpy(), len(keys_us) - 1
        lows = np.maximum(np.arange(pieces) - _REACH, 0)
        highs = np.minimum(np.arange(pieces) + _REACH + 1, pieces)
        width = int((first[highs] + 4 - first[lows]).max())
        starts = np.minimum(first[lows], self.count - width)
        held = np.zeros((pieces, 4, width), dtype=np.float32)
        for begin in range(0, pieces, _BLOCK):
            end = min(begin + _BLOCK, pieces)
            # Beside the block as many keys again, at whose ends the spline may bend otherwise.
            low, high = max(begin - 2 * _REACH, 0), min(end + 2 * _REACH, pieces) + 1
            origin = int(first[low])
            local = np.zeros(
                (high - low, max(int(first[high - 1]) + 4, starts[end - 1] + width) - origin)
            )
            columns = first[low:high, None] - origin + np.arange(4)
            np.put_along_axis(local, columns, four[low:high].numpy(), 1)
            curves = CubicSpline(seconds[low:high], local).c.transpose(1, 0, 2)
            for piece in range(begin, end):
                left = starts[piece] - origin
                inside = slice(max(left, 0), left + width)
                held[piece, :, max(-left, 0) :] = curves[piece - low][:, inside]
        return torch.from_numpy(held), torch.from_numpy(starts)

    def _through_keys(
        self, times: Float[Tensor, "T"]
    ) -> tuple[Int[Tensor, "T B"], Float[Tensor, "T B"]]:
        """Control points, and the cubic spline through what they weigh at the keys."""
        seconds = 1e-6 * (times.clamp(*self.span_us) - self.span_us[0])
        piece = torch.searchsorted(self.held_s, seconds, right=True) - 1
        piece = piece.clamp(0, len(self.held) - 1)
        step = (seconds - self.held_s[piece])[:, None]
        c3, c2, c1, c0 = self.held[piece].unbind(1)
        index = self.held_first[piece, None] + torch.arange(c0.shape[1])
        return index, ((c3 * step + c2) * step + c1) * step + c0

    def values(
        self, times_us: Sequence[int] | Tensor
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Values of the joints and of the root's place."""
        if (len(times_us) <= _BLOCK and self.count <= _DENSE) or math.isinf(self.knot_us):
            weights = self.weights(times_us)
            return torch.einsum("tk,kjc->tjc", weights, self.rotations), weights @ self.translations
        near = [self._near(block) for block in _on_host(times_us).split(_BLOCK)]
        turns, shifts = (torch.cat(blocks) for blocks in zip(*near, strict=True))
        if not len(self.held):  # what is held at keys is not centred
            mean = send(self.mean, self.rotations.device)
            turns = turns - torch.einsum("k,kjc->jc", mean, self.rotations)
            shifts = shifts - mean @ self.translations
        return turns, shifts

    def _near(
        self, times: Float[Tensor, "T"]
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Sums over the control points near the times alone; the mean is not taken off."""
        parts = self._local(times)
        first = min(int(index.min()) for index, _ in parts)
        end = max(int(index.max()) for index, _ in parts) + 1
        found = torch.zeros(len(times), end - first, dtype=torch.float64)
        for index, share in parts:
            found.scatter_add_(1, index - first, share)
        weights = send(found.to(self.rotations.dtype), self.rotations.device)
        turns = torch.einsum("tk,kjc->tjc", weights, self.rotations[first:end])
        return turns, weights @ self.translations[first:end]


def _on_host(times_us: Sequence[int] | Tensor) -> Float[Tensor, "T"]:
    return torch.as_tensor(times_us, dtype=torch.float64, device="cpu")
