"""Events that nothing in the scene has caused: background activity and hot pixels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from scipy.ndimage import binary_dilation, rank_filter

from evsplat.events import EventStore, EventStream
from evsplat.events.store import ALWAYS, Span
from evsplat.spread import evenly_spread

SUPPORT_US = 10_000
"""An event with another one at or beside its pixel within about this time is not noise."""
_PIECE_US = 1_000_000
_MOST_PIECES = 60
_MOST_EVENTS = 20_000_000
HOT_RATIO = 10.0
HOT_RATE_HZ = 5.0
_FLOOR_QUANTILE = 0.2
LEAST_QUIET_SHARE = 0.05
QUIET_DISTANCE_PX = 3
"""Nothing moves at pixels that are farther than this from any that had a supported event."""
_BESIDE = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
_AROUND = np.array(((1, 1, 1), (1, 0, 1), (1, 1, 1)))


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Background activity of a sensor."""

    rate_hz: float | None
    """Events per second and pixel where nothing moves; None where all of the picture moves."""
    brighter_share: float | None
    """Share of ON events among them (leak events of most sensors are all ON)."""
    hot_pixels: Int64[np.ndarray, "K 2"]
    """(x, y) of pixels that fire without cause, the most active first."""
    floor_hz: float = 0.0
    """Events per second that four pixels in five exceed: close to the background activity where it
    is so dense that all pixels look supported, above it where most of the picture moves."""

    @property
    def background_hz(self) -> float:
        """Background events per second and pixel: `rate_hz`, or `floor_hz` where that is None."""
        return self.floor_hz if self.rate_hz is None else self.rate_hz


class NoiseMeter:
    """Gathers unsupported events piece by piece.

    Support is the usual background-activity test (Delbruck 2008): another event at one of the nine
    pixels around within about 10 ms. Events at the borders of pieces may lose support.
    """

    def __init__(self, width: int, height: int) -> None:
        self.total: Int64[np.ndarray, "H W"] = np.zeros((height, width), dtype=np.int64)
        """Events so far per pixel."""
        self._supported = np.zeros((height, width), dtype=bool)
        self._lonely = np.zeros((2, height, width), dtype=np.int64)

    def add(self, chunk: EventStream) -> None:
        """Take in the next piece of the recording."""
        height, width = self.total.shape
        pixel = chunk.y.astype(np.int64) * width + chunk.x
        alone = ~_has_support(chunk, width, height)
        self._supported.reshape(-1)[pixel[~alone]] = True
        for counts, side in (
            (self.total, np.ones(len(chunk), dtype=bool)),
            (self._lonely[0], alone & (chunk.p > 0)),
            (self._lonely[1], alone & (chunk.p <= 0)),
        ):
            counts += np.bincount(pixel[side], minlength=width * height).reshape(height, width)

    def estimate(self, duration_us: int) -> NoiseEstimate:
        """Rate of unsupported events far from all supported ones, and hot pixels.

        A hot pixel fires at more than 5 Hz and ten times as often as all but one of its eight
        neighbours.
        """
        seconds = max(duration_us, 1) / 1e6
        hot = _hot_pixels(self.total, seconds)
        floor_hz = float(np.quantile(self.total, _FLOOR_QUANTILE)) / seconds
        quiet = ~binary_dilation(self._supported, iterations=QUIET_DISTANCE_PX)
        quiet[hot[:, 1], hot[:, 0]] = False
        if quiet.mean() < LEAST_QUIET_SHARE:
            return NoiseEstimate(None, None, hot, floor_hz)
        brighter, darker = (int(side[quiet].sum()) for side in self._lonely)
        events = brighter + darker
        return NoiseEstimate(
            rate_hz=events / (float(quiet.sum()) * seconds),
            brighter_share=brighter / events if events else None,
            hot_pixels=hot,
            floor_hz=floor_hz,
        )


def noise_of(events: EventStore, during_us: Span = ALWAYS) -> NoiseEstimate:
    """Background rate and hot pixels of what may be read of a recording, or of a part of it.

    Of a long part it is measured in `_MOST_PIECES` pieces of at most a second, evenly spread, which
    hold about `_MOST_EVENTS` events at most.
    """
    meter, seen_us = NoiseMeter(events.width, events.height), 0
    for start, end in _pieces(events, during_us):
        meter.add(events.between(start, end))
        seen_us += end - start
    return meter.estimate(seen_us)


def _pieces(events: EventStore, during_us: Span) -> list[Span]:
    """Stretches to read, in order of time, each within what may be read."""
    stretches = [
        (max(start, during_us[0]), min(end, during_us[1]))
        for start, end in events.stretches_us
        if start < during_us[1] and end > during_us[0]
    ]
    pieces = [
        (first, min(first + _PIECE_US, end))
        for start, end in stretches
        for first in range(start, end, _PIECE_US)
    ]
    pieces = evenly_spread(pieces, _MOST_PIECES)
    whole_us = sum(end - start for start, end in events.stretches_us)
    seen_us = sum(end - start for start, end in pieces)
    expected = len(events) * seen_us / max(whole_us, 1)
    if expected <= _MOST_EVENTS:
        return pieces
    share = _MOST_EVENTS / expected
    shorter = [round(share * (end - start)) for start, end in pieces]
    return [
        (start, min(end, start + max(length, 2 * SUPPORT_US)))
        for (start, end), length in zip(pieces, shorter, strict=True)
    ]


def _has_support(chunk: EventStream, width: int, height: int) -> np.ndarray:
    """True for events with another one in the nine pixels around, in the same or a next slice.

    Slices of half of `SUPPORT_US`, so that the time between is at most `SUPPORT_US` and a pixel's
    own second event counts as well.
    """
    if len(chunk) == 0:
        return np.zeros(0, dtype=bool)
    slice_of = (chunk.t - chunk.t[0]) // (SUPPORT_US // 2) + 1
    # A border of one pixel keeps neighbours of different rows apart.
    row = width + 2
    page = row * (height + 2)
    key = slice_of * page + (chunk.y.astype(np.int64) + 1) * row + chunk.x + 1
    keys, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    found = count > 1
    for after in (-1, 0, 1):
        for dy, dx in _BESIDE:
            shift = after * page + dy * row + dx
            if shift > 0:
                at = np.searchsorted(keys, keys + shift)
                met = (at < len(keys)) & (keys[np.minimum(at, len(keys) - 1)] == keys + shift)
                # Support is mutual.
                found |= met
                found[at[met]] = True
    return found[inverse]


def _hot_pixels(total: Int64[np.ndarray, "H W"], seconds: float) -> Int64[np.ndarray, "K 2"]:
    border = "mirror" if min(total.shape) > 1 else "constant"
    second = rank_filter(total, rank=-2, footprint=_AROUND, mode=border)
    hot = (total > HOT_RATE_HZ * seconds) & (total > HOT_RATIO * np.maximum(second, 1))
    y, x = np.nonzero(hot)
    order = np.argsort(-total[y, x], kind="stable")
    return np.stack([x, y], axis=-1)[order].astype(np.int64)
