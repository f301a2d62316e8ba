"""Times at which a sensor recorded nothing although pictures change: what a full buffer loses."""

from collections.abc import Sequence

import numpy as np

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.events import Span
from evsplat.events.maps import event_pixels

MUCH = 0.7
"""Change of log luminance that is several thresholds of any sensor."""
LEAST_PIXELS = 30
"""Fewer pixels that change so much may be noise of the frames."""
SILENT = 0.1
"""Share of those pixels below which the sensor is taken to have recorded nothing: where it does,
nearly all of them have events."""


def lost_spans(pairs: Sequence[FramePair], events: EventSource) -> list[Span]:
    """Between which frames much changed and hardly an event came, as mid-exposures; joined.

    Clocks that differ by less than the time between two frames change little: some of the events
    of a pair that moves come within it all the same. Pairs at whose time none were recorded or may
    be read are passed over.
    """
    found: list[Span] = []
    for pair in sorted(pairs, key=lambda pair: pair.span_us):
        moved = pair.usable & (np.abs(pair.change) > MUCH)
        if moved.sum() < LEAST_PIXELS or not pair.recorded_at(0):
            continue
        near = events.between(*pair.span_us)
        fired = np.zeros(moved.size, bool)
        fired[event_pixels(near, *moved.shape)] = True
        if fired[moved.ravel()].mean() >= SILENT:
            continue
        first, last = sum(pair.before_us) // 2, sum(pair.after_us) // 2
        if found and first <= found[-1][1]:
            found[-1] = found[-1][0], max(last, found[-1][1])
        else:
            found.append((first, last))
    return found
