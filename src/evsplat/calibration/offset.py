"""Offset of any length between the clocks of frames and events, from where the picture changes.

`evsplat.calibration.clock` measures a lag that is known to 100 ms; here nothing is known but that
both recorded the same. Frames and events are compared in a coarse grid of blocks, at all offsets.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from evsplat.calibration.brightness import SHORTEST_GAP_US, exposure, level_steps
from evsplat.calibration.clock import SEARCH_US
from evsplat.calibration.peak import top_near
from evsplat.events import EventStream
from evsplat.pictures.light import Transfer, decode
from evsplat.spread import evenly_spread

LEAST_CORRELATION = 0.5
"""Frames and events that agree less may be of two recordings."""
RIVAL = 0.8
"""Another peak must be lower than this share of the best one's correlation."""
LONGEST_S = 300
"""Takes 6 s and 0.4 GB at 25 frames per second; longer recordings are refused."""
_BLOCKS = 12
"""Along the longer side of the picture."""
_MOST_PAIRS = 120
_STEPS_PER_GAP = 16
_LEAST_STEP_US = 1_000
_ROUNDING = 0.1
"""Change of log luminance by which one step of 8 bits moves the darkest pixels that are told apart:
such that are darker count as if they were no darker."""
_LEAST_CHANGE = 1.5 * _ROUNDING
"""Smaller changes of a pixel count as none. Most are noise of the picture, which outweighs what
moves where most of it stands; and an event comes of a whole threshold alone."""
_LAGS_AT_ONCE = 2_048


class TooLong(ValueError):
    """A recording is longer than `LONGEST_S`; the message follows its path."""


@dataclass(frozen=True)
class OffsetEstimate:
    """What is added to the events' times to get the clock of the frames."""

    offset_us: float
    correlation: float
    """Of the blocks' changes, at ``offset_us``; changes that no event covers count as missed."""
    rival: float
    """The largest peak elsewhere."""

    @property
    def is_certain(self) -> bool:
        """True where frames and events agree there, and nowhere else nearly as well."""
        return self.correlation >= LEAST_CORRELATION and self.rival < RIVAL * self.correlation


class BlockChanges:
    """How blocks change from frame to frame, gathered one frame at a time, ascending in time."""

    def __init__(self, transfer: Transfer, size: tuple[int, int] | None = None) -> None:
        """``size`` is width and height of the sensor where pictures are made smaller than it."""
        self._transfer: Transfer = transfer
        self._size = size
        self._darkest = _darkest(transfer)
        self._before: tuple[Float[np.ndarray, "H W"], tuple[int, int]] | None = None
        self.changes: list[Float[np.ndarray, " B"]] = []
        """Mean change of log luminance in each block, of each pair of frames."""
        self.spans_us: list[tuple[tuple[int, int], tuple[int, int]]] = []
        """Exposures of both frames of each pair."""

    def add(self, image: Float[Tensor, "..."], span_us: tuple[int, int]) -> None:
        """A picture (H, W) or (H, W, 3) of coded values in [0, 1] and its exposure.

        One less than `SHORTEST_GAP_US` after the last that was taken is passed over.
        """
        if self._before is not None and sum(span_us) - sum(self._before[1]) < 2 * SHORTEST_GAP_US:
            return
        seen = exposure(image, span_us, transfer=self._transfer).log_luminance
        light = np.maximum(seen, self._darkest)
        if self._before is not None:
            change = light - self._before[0]
            change[np.abs(change) < _LEAST_CHANGE] = 0.0
            self.changes.append(block_means(_as_large(change, self._size)))
            self.spans_us.append((self._before[1], span_us))
        self._before = light, span_us


def estimate_offset(
    frames: BlockChanges, events: Iterable[EventStream], size: tuple[int, int]
) -> OffsetEstimate | None:
    """The offset at which what events add up to correlates best with how frames change.

    Tried are all offsets at which the events cover a change between two frames. ``events`` are the
    consecutive pieces of the recording, ``size`` is width and height of the sensor, which sees what
    the pictures show. None where nothing changes, or no event is there.

    Raises:
        TooLong: The recording is longer than `LONGEST_S`.
    """
    return next(iter(offsets_by_correlation(frames, events, size, 1)), None)


def offsets_by_correlation(
    frames: BlockChanges, events: Iterable[EventStream], size: tuple[int, int], most: int
) -> list[OffsetEstimate]:
    """As of `estimate_offset`, up to ``most`` peaks, the best first.

    They are more than `SEARCH_US` apart, up to which other searches find what is missing.
    """
    pairs = evenly_spread(range(len(frames.changes)), _MOST_PAIRS)
    if not pairs:
        return []
    spans = np.array(frames.spans_us, dtype=np.int64)[pairs]
    gap_us = float(np.median(spans[:, 1].mean(-1) - spans[:, 0].mean(-1)))
    step_us = max(_LEAST_STEP_US, round(gap_us / _STEPS_PER_GAP))
    level, first_us = _summed(events, size, step_us)
    if not len(level):
        return []
    changes = np.array(frames.changes)[pairs]
    begin_us = int(spans[0, 0, 0])
    starts = np.round((spans[..., 0] - begin_us) / step_us).astype(int)
    exposed = _exposed(level, float(np.median(spans[..., 1] - spans[..., 0])) / step_us)
    first_lag = -int(starts[:, 1].max())
    score = _scores(exposed, changes, starts, first_lag, len(exposed))
    around = np.pad(score, 1)
    left = np.where((score >= around[:-2]) & (score >= around[2:]), score, 0.0)
    found: list[OffsetEstimate] = []
    while len(found) < most and (left > 0).any():
        best = int(np.argmax(left))
        lag = first_lag + best + _beside(exposed, changes, starts, first_lag + best)
        offset_us = begin_us - first_us - step_us * lag
        found.append(OffsetEstimate(offset_us, float(score[best]), _rival(score, best)))
        near = math.ceil(SEARCH_US / step_us)
        left[max(0, best - near) : best + near + 1] = 0.0
    return found


def _grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows and columns of blocks by those of pixels, and how many columns there are."""
    side = -(-max(height, width) // _BLOCKS)
    return np.arange(height) // side, np.arange(width) // side, -(-width // side)


def block_means(pixels: Float[np.ndarray, "H W"]) -> Float[np.ndarray, " B"]:
    """Mean over the pixels of each block."""
    rows, columns, count = _grid(*pixels.shape)
    block = (rows[:, None] * count + columns).ravel()
    return np.bincount(block, pixels.ravel()) / np.bincount(block)


def _as_large(
    pixels: Float[np.ndarray, "h w"], size: tuple[int, int] | None
) -> Float[np.ndarray, "H W"]:
    """Each pixel as often as ``size``, width and height, asks for, so that blocks are the same."""
    if size is None or pixels.shape == size[::-1]:
        return pixels
    rows, columns = (
        np.arange(whole) * n // whole for n, whole in zip(pixels.shape, size[::-1], strict=True)
    )
    return pixels[rows[:, None], columns]


def _darkest(transfer: Transfer) -> float:
    """Logarithm of the least light at which one step of 8 bits changes it by `_ROUNDING`."""
    light = torch.log(decode(torch.arange(1, 256, dtype=torch.float64) / 255, transfer))
    return float(light[int(torch.argmax((light.diff() <= _ROUNDING).int()))])


def _summed(
    events: Iterable[EventStream], size: tuple[int, int], step_us: int
) -> tuple[Float32[np.ndarray, "T B"], int]:
    """Sum of the pixels' levels in each block at the end of each step, and the first one's start.

    Levels are in thresholds, the most likely ones after each event (`level_steps`).
    """
    rows, columns, count = _grid(size[1], size[0])
    blocks = (rows[-1] + 1) * count
    last = np.zeros(size[0] * size[1])
    pieces: list[tuple[int, np.ndarray]] = []
    first_us = 0
    for piece in events:
        if not len(piece):
            continue
        first_us = first_us if pieces else int(piece.t[0])
        step = (np.asarray(piece.t) - first_us) // step_us
        if step[-1] * step_us > LONGEST_S * 1e6:
            raise TooLong(
                f"its events last longer than {LONGEST_S} s, in which no offset is searched for"
            )
        start = int(step[0])
        place = (step - start) * blocks + rows[piece.y] * count + columns[piece.x]
        pixel = piece.y.astype(np.int64) * size[0] + piece.x
        lifted = level_steps(pixel, np.asarray(piece.p) > 0, last)
        sums = np.bincount(place, lifted, minlength=(int(step[-1]) - start + 1) * blocks)
        pieces.append((start, sums.reshape(-1, blocks).astype(np.float32)))
    total = np.zeros((max((s + len(a) for s, a in pieces), default=0), blocks), np.float32)
    for start, sums in pieces:
        total[start : start + len(sums)] += sums
    return np.cumsum(total, axis=0, out=total), first_us


def _exposed(level: Float32[np.ndarray, "T B"], steps: float) -> Float32[np.ndarray, "S B"]:
    """Mean level in an exposure of so many steps that begins at each step."""
    length = max(1, round(steps))
    whole = np.concatenate([np.zeros((1, level.shape[1])), np.cumsum(level, axis=0, dtype=float)])
    return ((whole[length:] - whole[:-length]) / length).astype(np.float32)


def _scores(
    exposed: Float32[np.ndarray, "S B"],
    changes: Float[np.ndarray, "P B"],
    starts: Int64[np.ndarray, "P 2"],
    first: int,
    end: int,
) -> Float[np.ndarray, " L"]:
    """Correlation at each lag ``first <= lag < end``, in steps.

    ``starts`` are the first steps of the two exposures of a pair. Of the changes in a block, and of
    what events say there, the mean over pairs is taken off: light that comes and goes, and noise
    that is mostly of one sign.
    """
    steps, blocks = exposed.shape
    centred = (changes - changes.mean(0)).astype(np.float32)
    power = float((centred**2).sum())
    parts = [np.zeros(0)]
    for begin in range(first, end, _LAGS_AT_ONCE):
        lags = min(_LAGS_AT_ONCE, end - begin)
        told_sum, change_sum = np.zeros((2, lags, blocks), np.float32)
        squares, products, count = np.zeros((3, lags))
        for change, (before, after) in zip(centred, starts, strict=True):
            low, high = max(begin, -before), min(begin + lags, steps - after)
            if low >= high:
                continue
            here = slice(low - begin, high - begin)
            told = exposed[low + after : high + after] - exposed[low + before : high + before]
            told_sum[here] += told
            change_sum[here] += change
            squares[here] += np.einsum("lb,lb->l", told, told)
            products[here] += told @ change
            count[here] += 1
        count = np.maximum(count, 1)
        varied = squares - (told_sum**2).sum(1) / count
        products -= (told_sum * change_sum).sum(1) / count
        with np.errstate(all="ignore"):
            score = products / np.sqrt(varied * power)
        parts.append(np.where(np.isfinite(score), score, 0.0))
    return np.concatenate(parts)


def _beside(
    exposed: Float32[np.ndarray, "S B"],
    changes: Float[np.ndarray, "P B"],
    starts: Int64[np.ndarray, "P 2"],
    lag: int,
) -> float:
    """Steps from a lag to the best one near it, by the pairs that are covered at all of those.

    Of all pairs, one that is covered at the next lag only would outweigh how well the others fit.
    """
    first, end = lag - _STEPS_PER_GAP, lag + _STEPS_PER_GAP + 1
    covered = (starts[:, 0] + first >= 0) & (starts[:, 1] + end <= len(exposed))
    if covered.sum() < 2:
        return 0.0
    score = _scores(exposed, changes[covered], starts[covered], first, end)
    best = int(np.argmax(score))
    if best in (0, len(score) - 1):
        return 0.0
    return top_near(score, best) - _STEPS_PER_GAP


def _rival(score: Float[np.ndarray, " L"], best: int) -> float:
    """The largest peak outside of the stretch about the best in which the score stays high."""
    low = np.flatnonzero(score < RIVAL * score[best])
    before, after = low[low < best], low[low > best]
    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]))
    elsewhere = peaks < (before[-1] if len(before) else 0)
    elsewhere |= peaks > (after[0] if len(after) else len(score))
    return float(score[peaks[elsewhere]].max(initial=0.0))
