"""Times and places at which a sensor recorded nothing although pictures change.

Times are what a full buffer loses; places, what a sensor coarser than the pictures leaves between
its pixels, or events that were warped elsewhere.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.events import EventStore, Span
from evsplat.events.maps import event_pixels

MUCH = 0.7
"""Change of log luminance that is several thresholds of any sensor."""
LEAST_PIXELS = 30
"""Fewer pixels that change so much may be noise of the frames."""
SILENT = 0.1
"""Share of those pixels below which the sensor is taken to have recorded nothing: where it does,
nearly all of them have events."""
_AS_EVER = 0.5
"""Share of their usual rate from which events are taken to have come as ever."""
_LOOK_US = 20_000
"""Read at first in search of the next event; then twice as long each time."""
VERY_MUCH = 1.5
"""Change that stays above thresholds where linear frames are taken as coded, 2.2 times as large."""


def lost_spans(pairs: Sequence[FramePair], events: EventSource) -> list[Span]:
    """Between which frames much changed and hardly an event came, as mid-exposures; joined.

    Clocks that differ by less than the time between two frames change little: some of the events
    of a pair that moves come within it all the same. Pairs at whose time none were recorded or may
    be read are passed over.
    """
    found: list[Span] = []
    for pair in _unanswered(pairs, events):
        first, last = sum(pair.before_us) // 2, sum(pair.after_us) // 2
        if found and first <= found[-1][1]:
            found[-1] = found[-1][0], max(last, found[-1][1])
        else:
            found.append((first, last))
    return found


def untold_spans(pairs: Sequence[FramePair], events: EventStore) -> list[Span]:
    """Times, in order and apart, of which events say nothing: `lost_spans` and the silence about
    each, from the last event before it to the first one after.

    A sensor begins and ends to lose events within exposures, and beside held-out intervals, where
    no pair tells. If silence was honest there, that nothing moved is all that is not learned from
    it. Empty where events were not lost but lie in other pixels.
    """
    lost = lost_spans(pairs, events)
    if not lost or came_elsewhere(pairs, events):
        return []
    found: list[Span] = []
    for first, last in lost:
        start, end = _event_before(first, events), _event_after(last, events)
        if found and start <= found[-1][1]:
            start, end = found[-1][0], max(end, found[-1][1])
            found.pop()
        found.append((start, end))
    return found


def _event_before(time_us: int, events: EventStore) -> int:
    """When the last readable event before a time has passed; ``time_us`` where none has."""
    for start, end in reversed(events.stretches_us):
        high, step = min(end, time_us), _LOOK_US
        while high > start:
            low = max(start, high - step)
            found = events.between(low, high).t
            if len(found):
                return int(found[-1]) + 1
            high, step = low, 2 * step
    return time_us


def _event_after(time_us: int, events: EventStore) -> int:
    """When the first readable event from a time on comes; ``time_us`` where none does."""
    for start, end in events.stretches_us:
        low, step = max(start, time_us), _LOOK_US
        while low < end:
            high = min(end, low + step)
            found = events.between(low, high).t
            if len(found):
                return int(found[0])
            low, step = high, 2 * step
    return time_us


def came_elsewhere(pairs: Sequence[FramePair], events: EventSource) -> bool:
    """Whether in `lost_spans` events came as ever, at other pixels than those that changed.

    Such events were not lost: they lie in other pixels than the frames'. A change that is so large
    makes several at each pixel, and a sensor that loses them falls silent.
    """
    lost = _unanswered(pairs, events)
    changed = sum(int(_moved(pair, MUCH).sum()) for pair in lost)
    came, rate = _came(lost, events)
    usual = _came([pair for pair in pairs if pair.recorded_at(0)], events)[1]
    return changed > 0 and came >= changed and rate >= _AS_EVER * usual


def _unanswered(pairs: Sequence[FramePair], events: EventSource) -> list[FramePair]:
    """Pairs between which much changed and hardly an event came there, in order of time."""
    found = []
    for pair in sorted(pairs, key=lambda pair: pair.span_us):
        moved = _moved(pair, MUCH)
        if moved.sum() < LEAST_PIXELS or not pair.recorded_at(0):
            continue
        if _fired(pair, events)[moved].mean() < SILENT:
            found.append(pair)
    return found


def _came(pairs: Sequence[FramePair], events: EventSource) -> tuple[int, float]:
    """Number of events during pairs, all pixels together, and their rate per microsecond."""
    count = sum(len(events.between(*pair.span_us)) for pair in pairs)
    return count, count / max(1, sum(pair.span_us[1] - pair.span_us[0] for pair in pairs))


def answered_share(pairs: Sequence[FramePair], events: EventSource) -> float | None:
    """Share of the pixels that change by more than `VERY_MUCH` between two frames that had an
    event meanwhile, over all pairs; None where `LEAST_PIXELS` do not change so much.

    Sensors whose pixels are those of the frames have events at nine of ten or more, whatever their
    noise, with clocks up to half a frame apart.
    """
    changed = answered = 0
    for pair in pairs:
        moved = _moved(pair, VERY_MUCH)
        if moved.any() and pair.recorded_at(0):
            changed += int(moved.sum())
            answered += int(_fired(pair, events)[moved].sum())
    return answered / changed if changed >= LEAST_PIXELS else None


def _moved(pair: FramePair, least: float) -> Bool[np.ndarray, "H W"]:
    """Pixels that change by more than ``least`` beside what the camera itself changed."""
    return pair.usable & (np.abs(pair.change - pair.camera_change) > least)


def _fired(pair: FramePair, events: EventSource) -> Bool[np.ndarray, "H W"]:
    """Pixels that had an event from the begin of one exposure to the end of the other."""
    height, width = pair.change.shape
    fired = np.zeros(height * width, bool)
    fired[event_pixels(events.between(*pair.span_us), height, width)] = True
    return fired.reshape(height, width)
