"""Change of brightness between two frames, as the frames and as the events show it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from evsplat.errors import DataError
from evsplat.events import EventStore, EventStream, Span
from evsplat.events.maps import event_pixels
from evsplat.pictures.light import Transfer, decode, luminance
from evsplat.spread import evenly_spread

DARKEST, BRIGHTEST = 0.02, 0.98
"""Coded values outside of this range are mostly noise, or clipped."""
SHORTEST_GAP_US = 20_000
"""Frames that follow each other faster are skipped: little changes between them."""
HISTORY_US = 100_000
"""Time before a pair in which the last event of a pixel is looked for."""
MOST_EVENTS = 10_000
"""About a pair of frames; of more a part is taken."""


EventSource = EventStream | EventStore
"""Events by time, in memory or on disk."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Brightness of a frame."""

    log_luminance: Float[np.ndarray, "H W"]
    """Natural logarithm of linear luminance."""
    usable: Bool[np.ndarray, "H W"]
    """Pixels that are neither too dark nor clipped."""
    span_us: tuple[int, int]
    """Start and end of the exposure."""


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two exposures and how the logarithm of luminance changed from one to the other."""

    before_us: tuple[int, int]
    after_us: tuple[int, int]
    change: Float[np.ndarray, "H W"]
    usable: Bool[np.ndarray, "H W"]
    recorded_us: Span
    """Stretch around the pair in which events were recorded and may be read; the only one read."""

    @property
    def span_us(self) -> tuple[int, int]:
        """Time in which events contribute to the change."""
        return min(self.before_us[0], self.after_us[0]), max(self.before_us[1], self.after_us[1])

    @cached_property
    def camera_change(self) -> float:
        """What most usable pixels change by, the camera's own exposure and gain; 0 where none is.

        An event sensor knows nothing of that.
        """
        return float(np.median(self.change[self.usable])) if self.usable.any() else 0.0

    @property
    def gap_us(self) -> float:
        """Time between the two mid-exposures."""
        return (sum(self.after_us) - sum(self.before_us)) / 2

    def weights(self, times_us: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Share of the change of log luminance at each time that is in the change of the pair."""
        return _elapsed(times_us, self.before_us) - _elapsed(times_us, self.after_us)

    def recorded_at(self, lag_us: float) -> bool:
        """True where all events of the pair are there that come ``lag_us`` later than it."""
        start, end = self.span_us
        return start + lag_us >= self.recorded_us[0] and end + lag_us <= self.recorded_us[1]


def exposure(
    image: Float[Tensor, "..."],
    span_us: tuple[int, int],
    *,
    transfer: Transfer = "power",
) -> Exposure:
    """Brightness of a picture (H, W) or (H, W, 3) with coded values in [0, 1].

    ``transfer`` is the camera's curve; "linear" for sensors that store what they measure, as the
    pictures in a DAVIS recording.
    """
    rgb = image if image.ndim == 3 else image[..., None].expand(-1, -1, 3)
    linear = decode(rgb, transfer)
    usable = (rgb > DARKEST).all(-1) & (rgb < BRIGHTEST).all(-1)
    # The clamp only keeps the logarithm finite: such pixels are not usable.
    return Exposure(
        torch.log(luminance(linear).clamp_min(1e-6)).cpu().numpy(), usable.cpu().numpy(), span_us
    )


def pair(before: Exposure, after: Exposure, recorded_us: Span) -> FramePair:
    """Two exposures as a pair; ``recorded_us``: when events were recorded and may be read.

    Raises:
        DataError: pictures of two sizes.
    """
    if before.log_luminance.shape != after.log_luminance.shape:
        raise DataError(
            f"frames of {before.log_luminance.shape[::-1]} and {after.log_luminance.shape[::-1]} "
            "pixels cannot be compared; give frames of one size."
        )
    change = after.log_luminance - before.log_luminance
    usable = before.usable & after.usable
    return FramePair(before.span_us, after.span_us, change, usable, recorded_us)


def pair_indices(
    spans_us: Sequence[tuple[int, int]], most: int, *, stretch: Sequence[Span] | None = None
) -> list[tuple[int, int]]:
    """At most ``most`` pairs of frames next to each other but `SHORTEST_GAP_US` apart, spread.

    ``spans_us`` are start and end of each exposure, ascending; ``stretch`` is the stretch of time
    of each frame; pairs lie in one.
    """
    middle = np.array([(start + end) / 2 for start, end in spans_us])
    after = np.searchsorted(middle, middle + SHORTEST_GAP_US)
    found = [(i, max(int(j), i + 1)) for i, j in enumerate(after) if j < len(middle)]
    if stretch is not None:
        found = [(i, j) for i, j in found if stretch[i] == stretch[j]]
    return evenly_spread(found, most)


class PairEvents:
    """The events about a pair of exposures, and the change at the pixels where they are.

    Of a busy recording only every n-th pixel is kept, so that no pair takes part with many more
    than `MOST_EVENTS`: many thousand pixels say as much as a million.
    """

    def __init__(self, pair: FramePair, events: EventSource, lags_us: tuple[float, float]) -> None:
        """Read what ``counts`` needs for lags in the given range."""
        self.pair = pair
        start, end = pair.span_us
        first = max(start + math.floor(lags_us[0]) - HISTORY_US, pair.recorded_us[0])
        last = min(end + math.ceil(lags_us[1]) + 1, pair.recorded_us[1])
        near = events.between(first, max(first, last))
        height, width = pair.change.shape
        pixel = event_pixels(near, height, width, "frames and events must share their pixels")
        share = max(1, len(near) // MOST_EVENTS)
        # A stride that has no factor in common with the width meets all columns.
        while math.gcd(share, width) > 1:
            share += 1
        kept = pixel % share == 0
        self._t = near.t[kept]
        self._brighter = near.p[kept] > 0
        pixels, self._pixel = np.unique(pixel[kept], return_inverse=True)
        self._steps = level_steps(self._pixel, self._brighter)
        self.change: Float[np.ndarray, K] = pair.change.reshape(-1)[pixels].astype(np.float64)
        self.usable: Bool[np.ndarray, K] = pair.usable.reshape(-1)[pixels]

    def counts(self, lag_us: float) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
        """Brighter and darker events per pixel between the two exposures, ``lag_us`` later.

        The mean of log intensity over an exposure sees an event by the part of the exposure that
        comes after it. So an event counts with a weight that rises from 0 to 1 over the first
        exposure and falls again over the second; for short exposures this is the count between
        mid-exposures.
        """
        within, weight = self._weights(lag_us)
        pixel, brighter = self._pixel[within], self._brighter[within]
        plus = np.bincount(pixel, weight * brighter, len(self.change))
        return plus, np.bincount(pixel, weight, len(self.change)) - plus

    def level_change(self, lag_us: float) -> tuple[Float[np.ndarray, "K"], Bool[np.ndarray, "K"]]:
        """Change of the most likely level in thresholds (`level_steps`); who has any event."""
        within, weight = self._weights(lag_us)
        pixel, count = self._pixel[within], len(self.change)
        level = np.bincount(pixel, weight * self._steps[within], count)
        return level, np.bincount(pixel, weight, count) > 0

    def _weights(self, lag_us: float) -> tuple[slice, Float[np.ndarray, "N"]]:
        pair, shift = self.pair, round(lag_us)
        start, end = (time + shift for time in pair.span_us)
        within = slice(*np.searchsorted(self._t, [start, end]))
        t = self._t[within] - shift
        return within, pair.weights(t)


def level_steps(
    pixel: Int64[np.ndarray, "N"],
    brighter: Bool[np.ndarray, "N"],
    last: Float[np.ndarray, "P"] | None = None,
) -> Float[np.ndarray, "N"]:
    """Thresholds by which each event lifts the most likely level.

    An event comes when a whole threshold has been passed. Until the next one the level lies up to
    a threshold further in the same direction, half of it on average; a plain sum of polarities
    would always be late. So an event with the polarity of its pixel's last one counts 1, and one
    of the other polarity takes back the half threshold of the last and adds its own. What was
    before the first is not known: it counts one and a half.

    Of a recording that is read in pieces ``last`` has the polarity of every pixel's last event, 0
    before the first; it is brought up to date.
    """
    order = np.argsort(pixel, kind="stable")
    sign, place = np.where(brighter[order], 1.0, -1.0), pixel[order]
    goes_on = np.diff(place, prepend=-1) == 0
    before = np.concatenate([[0.0], sign])[:-1]
    before = np.where(goes_on, before, 0.0 if last is None else last[place])
    if last is not None:
        last[place] = sign  # of several events at a pixel numpy keeps the one assigned last
    steps = np.empty(len(sign))
    steps[order] = sign + 0.5 * (sign - before)
    return steps


def _elapsed(t: np.ndarray, span_us: tuple[int, int]) -> np.ndarray:
    """Share of the exposure that lies before each time."""
    start, end = span_us
    return np.clip((t - start) / (end - start), 0.0, 1.0)
