"""Whether events are mirrored or turned beside the frames, or have the other sign.

A beam splitter mirrors one of two cameras, drivers turn pictures and not events, and some write the
polarity the other way round. Such a recording is whole and valid, and teaches the opposite.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.calibration.clock import SEARCH_US, correlations_at
from evsplat.calibration.ways import WAYS, Way, in_words, turned, way_homography, ways_of
from evsplat.events.homography import Homography

SURE = 0.5
"""Frames and events that correlate so well belong together as they are: they do at 0.8 to 0.97 in
recordings and staged captures, and mirrored at less than 0.25."""
LEAD = 0.5
"""Another way has to be better by so much of what the given one lacks to a correlation of 1. Motion
that swings to and fro fits with the other sign as well, half a swing later, but less."""


@dataclass(frozen=True)
class Disagreement:
    """The way in which events do fit the frames, which is not that in which they are given."""

    turned: str
    """What would lay the events onto the frames, in words; empty where they lie there."""
    inverted: bool
    """True where they say darker of what grows brighter."""
    correlation: float
    """Of changes in the frames with what the events add up to, in that way."""
    as_given: float
    """The same, as they are given; 0 where no correlation is positive."""
    size_px: tuple[int, int]
    """Width and height of the frames."""

    @property
    def homography(self) -> Homography:
        """(3, 3), by which `evsplat.events.moved` brings events into the pixels of the frames."""
        return way_homography(WAYS[self.turned], self.size_px)

    def __str__(self) -> str:
        words = in_words(self.turned, inverted=self.inverted)
        return (
            f"events that fit the frames only if they were {words} (correlation "
            f"{self.correlation:.2f}, as they are {self.as_given:.2f})"
        )


def estimate_disagreement(pairs: Sequence[FramePair], events: EventSource) -> Disagreement | None:
    """The way in which events fit the frames, if it is surely not the given one; else None.

    Clocks may differ by up to 0.1 s, as for `evsplat.calibration.clock.estimate_clock`.
    """
    if not pairs:
        return None
    step = max(500.0, float(np.median([pair.gap_us for pair in pairs])) / 4)
    lags = np.arange(-round(SEARCH_US / step), round(SEARCH_US / step) + 1) * step

    def found(way: Way) -> tuple[float, float]:
        """The largest correlation, and the largest of the other sign; 0 where there is none."""
        views = [
            replace(pair, change=turned(pair.change, way), usable=turned(pair.usable, way))
            for pair in pairs
        ]
        at = np.nan_to_num(correlations_at(views, events, lags))
        return max(0.0, float(at.max())), max(0.0, float(-at.min()))

    as_given, inverse = found(WAYS[""])
    if as_given >= SURE and inverse <= _needed(as_given):
        return None
    height, width = pairs[0].change.shape
    size = width, height
    best = Disagreement("", True, inverse, as_given, size)
    for name, way in ways_of(size).items():
        for inverted, correlation in enumerate(found(way) if name else ()):
            if correlation > best.correlation:
                best = Disagreement(name, bool(inverted), correlation, as_given, size)
    sure = best.correlation >= SURE and best.correlation > _needed(as_given)
    return best if sure else None


def _needed(as_given: float) -> float:
    return as_given + LEAD * (1 - as_given)
