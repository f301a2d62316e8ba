"""Learned course of a turn per joint and of a shift of the root: a cubic B-spline in time."""

import math
import mmap
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
"""Keys whose values the slope at a key knows on either side; slopes made, and times evaluated, at a
time."""
_DENSE = 8 * _BLOCK
"""Control points up to which each time weighs all of them; of more only those near it."""
_APART = _BLOCK
"""Control points of a parameter where they are more than that, and held at keys: an optimiser then
has moments of stretches of the recording that were met, and steps those of the frame alone."""


class PoseSpline(nn.Module):
    """Values ``w(t) . c`` with uniform knots; no units.

    Control points c, ``rotations`` (K, J, 3) and ``translations`` (K, 3), start at zero. Variants:

    - ``centred_us``: the mean over these times is zero. A constant and a canonical shape that is
      bent the other way look the same, and the shape follows all frames.
    - ``held_us``: zero at each of these times. Taken off is the cubic spline through its own values
      there; what is left is how it moves from one to the next. More than `_DENSE` control points
      are lists of `_APART` each.
    """

    rotations: Tensor | nn.ParameterList
    translations: Tensor | nn.ParameterList

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
        self.held_us = torch.tensor(held_us if len(held_us) > 1 else [], dtype=torch.float64)
        if len(self.held_us):
            self.slopes, self.slopes_first = self._slopes()
        elif len(centred_us) and not math.isinf(knot_us):
            self.mean = self._mean(torch.as_tensor(centred_us, dtype=torch.float64))
        starts = {
            "rotations": _zeros(self.count, joints, 3),
            "translations": _zeros(self.count, 3),
        }
        for name, value in starts.items():
            if learned and len(self.held_us) and self.count > _DENSE:
                parts = value.split(_APART)
                setattr(self, name, nn.ParameterList(nn.Parameter(part) for part in parts))
            elif learned:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    @property
    def device(self) -> torch.device:
        """Of the control points."""
        return _joined(self.translations, 0, 1).device

    def still_zero(self, times_us: Sequence[int] | Tensor) -> bool:
        """Whether all control points near these times are zero as they were at the start.

        Asked only of those that come in parts, since a GPU has to be waited for.
        """
        if not isinstance(self.rotations, nn.ParameterList):
            return False
        first, end = _range(self._local(_on_host(times_us)))
        both = self.rotations, self.translations
        return not any(bool(_joined(points, first, end).any()) for points in both)

    def whole(self) -> tuple[Float[Tensor, "K J 3"], Float[Tensor, "K 3"]]:
        """All control points, in place where they are one parameter."""
        return _joined(self.rotations, 0, self.count), _joined(self.translations, 0, self.count)

    def weights(self, times_us: Sequence[int] | Tensor) -> Float[Tensor, "T K"]:
        """Weights of the control points at given times, on the device of the control points."""
        device = self.device
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
        """Control points that count at each time, and their weights: several that add up.

        The mean is not taken off.
        """
        first, four = self._four(times)
        parts = [(first[:, None] + torch.arange(4), four)]
        if len(self.held_us):
            parts += [(index, -share) for index, share in self._through_keys(times)]
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

    def _slopes(self) -> tuple[Float[Tensor, "P B"], Int[Tensor, "P"]]:
        """Slopes at the keys, per second, of cubic splines through what the control points weigh
        there, and the first of these.

        At each key those of the `_REACH` keys before and after: farther ones count less than a
        rounding error, since a spline forgets three quarters of a value from one key to the next.
        So memory grows with the number of keys, not with its square: 250 B a key.
        """
        index, four = self._four(self.held_us)
        first, keys = index.numpy(), len(self.held_us)
        seconds = 1e-6 * (self.held_us - self.span_us[0]).numpy()
        lows = np.maximum(np.arange(keys) - _REACH, 0)
        highs = np.minimum(np.arange(keys) + _REACH, keys - 1)
        width = int((first[highs] + 4 - first[lows]).max())
        starts = np.minimum(first[lows], self.count - width)
        slopes = np.zeros((keys, width), dtype=np.float32)
        for begin in range(0, keys, _BLOCK):
            end = min(begin + _BLOCK, keys)
            # Beside the block as many keys again, at whose ends the spline may bend otherwise.
            low, high = max(begin - 2 * _REACH, 0), min(end + 2 * _REACH, keys)
            origin = int(first[low])
            local = np.zeros(
                (high - low, max(int(first[high - 1]) + 4, starts[end - 1] + width) - origin)
            )
            columns = first[low:high, None] - origin + np.arange(4)
            np.put_along_axis(local, columns, four[low:high].numpy(), 1)
            found = CubicSpline(seconds[low:high], local)(seconds[begin:end], 1)
            for key in range(begin, end):
                left = starts[key] - origin
                inside = slice(max(left, 0), left + width)
                slopes[key, max(-left, 0) :] = found[key - begin][inside]
        return torch.from_numpy(slopes), torch.from_numpy(starts)

    def _through_keys(self, times: Float[Tensor, "T"]) -> list[tuple[Tensor, Tensor]]:
        """As `_local`, of the cubic spline through the values at the keys.

        On each piece it is the cubic with the values and the slopes of its ends.
        """
        times = times.clamp(*self.span_us)
        piece = torch.searchsorted(self.held_us, times, right=True) - 1
        piece = piece.clamp(0, len(self.held_us) - 2)
        gap_s = 1e-6 * (self.held_us[piece + 1] - self.held_us[piece])
        step = 1e-6 * (times - self.held_us[piece]) / gap_s
        before, after = (1 - step) ** 2, step**2
        parts = []
        for key, value, slope in (
            (piece, (1 + 2 * step) * before, step * before),
            (piece + 1, (3 - 2 * step) * after, (step - 1) * after),
        ):
            first, four = self._four(self.held_us[key])
            parts.append((first[:, None] + torch.arange(4), value[:, None] * four))
            near = self.slopes_first[key, None] + torch.arange(self.slopes.shape[1])
            parts.append((near, (gap_s * slope)[:, None] * self.slopes[key]))
        return parts

    def values(
        self, times_us: Sequence[int] | Tensor
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Values of the joints and of the root's place."""
        if (len(times_us) <= _BLOCK and self.count <= _DENSE) or math.isinf(self.knot_us):
            weights, (rotations, translations) = self.weights(times_us), self.whole()
            return torch.einsum("tk,kjc->tjc", weights, rotations), weights @ translations
        near = [self._near(block) for block in _on_host(times_us).split(_BLOCK)]
        turns, shifts = (torch.cat(blocks) for blocks in zip(*near, strict=True))
        if not len(self.held_us):  # what is held at keys is not centred
            mean, (rotations, translations) = send(self.mean, self.device), self.whole()
            turns = turns - torch.einsum("k,kjc->jc", mean, rotations)
            shifts = shifts - mean @ translations
        return turns, shifts

    def _near(
        self, times: Float[Tensor, "T"]
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Sums over the control points near the times alone; the mean is not taken off."""
        parts = self._local(times)
        first, end = _range(parts)
        found = torch.zeros(len(times), end - first, dtype=torch.float64)
        for index, share in parts:
            found.scatter_add_(1, index - first, share)
        weights = send(found.float(), self.device)
        turns = torch.einsum("tk,kjc->tjc", weights, _joined(self.rotations, first, end))
        return turns, weights @ _joined(self.translations, first, end)


def _zeros(*shape: int) -> Tensor:
    """Zeros, of which many take no memory until they are written: not all splines count."""
    if (size := 4 * math.prod(shape)) < mmap.PAGESIZE:
        return torch.zeros(shape)
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return torch.from_numpy(np.frombuffer(pages, np.float32).reshape(shape))


def _joined(points: Tensor | nn.ParameterList, first: int, end: int) -> Tensor:
    """Those control points, of one parameter or of a list of such."""
    if isinstance(points, Tensor):
        return points if (first, end) == (0, len(points)) else points[first:end]
    parts = range(first // _APART, -(-end // _APART))
    near = [points[i][max(first - i * _APART, 0) : end - i * _APART] for i in parts]
    return near[0] if len(near) == 1 else torch.cat(near)


def _range(parts: list[tuple[Tensor, Tensor]]) -> tuple[int, int]:
    """The first control point that counts, and one past the last."""
    first = min(int(index.min()) for index, _ in parts)
    return first, max(int(index.max()) for index, _ in parts) + 1


def _on_host(times_us: Sequence[int] | Tensor) -> Float[Tensor, "T"]:
    return torch.as_tensor(times_us, dtype=torch.float64, device="cpu")
