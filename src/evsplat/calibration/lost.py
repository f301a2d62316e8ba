"""Times and places at which a sensor recorded nothing although pictures change.

Times are what a full buffer loses; places, what a sensor coarser than the pictures leaves between
its pixels, or events that were warped elsewhere.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

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
_NEXT_TO_NONE = 0.01
"""Share of the usual rate of events up to which a sensor pauses: it has no more noise then."""
_BESIDE = 2
"""Pairs of frames on either side of a pause whose events tell how suddenly it came: in the first
one it began."""
_MOST_PAUSES = 30
"""Of which pictures are read, three each."""
_TOLD = 0.5
"""Share of what events usually tell of a change, below which much of it was before the first."""
_FEWEST_OTHERS = 3
"""Pairs that say what is usual."""
VERY_MUCH = 1.5
"""Change that stays above thresholds where linear frames are taken as coded, 2.2 times as large."""


@dataclass(frozen=True)
class Lost:
    """Times at which pictures change and hardly an event came where they do."""

    spans_us: tuple[Span, ...] = ()
    """Mid-exposures between which that is so, in order and apart."""
    elsewhere: bool = False
    """Whether events came as ever meanwhile, at other pixels than those that changed. They were not
    lost then but lie in other pixels than the frames': a change that is so large makes several at
    each pixel, and a sensor that loses them falls silent."""


@dataclass(frozen=True)
class _Unanswered:
    """A pair between which much changed and hardly an event came there."""

    mids_us: Span
    span_us: Span
    changed: int
    """Pixels."""

    @classmethod
    def of(cls, pair: FramePair, events: EventSource) -> "_Unanswered | None":
        """None where it is answered, or its events were not recorded or may not be read."""
        moved = _moved(pair, MUCH)
        if moved.sum() < LEAST_PIXELS or not pair.recorded_at(0):
            return None
        if _fired(pair, events)[moved].mean() >= SILENT:
            return None
        mids_us = sum(pair.before_us) // 2, sum(pair.after_us) // 2
        return cls(mids_us, pair.span_us, int(moved.sum()))


def find_lost(
    pairs: Sequence[FramePair], events: EventSource, more: Iterable[FramePair] = ()
) -> Lost:
    """When events did not tell what changed between two frames of a pair.

    ``more`` are pairs that are not spread over the recording as ``pairs`` are, looked at one after
    the other. Clocks that differ by less than the time between two frames change little: some of
    the events of a pair that moves come within it all the same. Pairs at whose time none were
    recorded or may be read are passed over.
    """
    looked_at = (_Unanswered.of(pair, events) for pair in chain(pairs, more))
    lost = sorted((one for one in looked_at if one is not None), key=lambda one: one.span_us)
    if not lost:
        return Lost()
    came, rate = _came([one.span_us for one in lost], events)
    usual = _came([pair.span_us for pair in pairs if pair.recorded_at(0)], events)[1]
    as_many = came >= sum(one.changed for one in lost)
    return Lost(_joined(one.mids_us for one in lost), as_many and rate >= _AS_EVER * usual)


def untold_spans(lost: Lost, events: EventStore) -> list[Span]:
    """Times, in order and apart, of which events say nothing: what was lost and the silence about
    it, from the last event before to the first one after.

    A sensor begins and ends to lose events within exposures, and beside held-out intervals, where
    no pair tells. If silence was honest there, that nothing moved is all that is not learned from
    it. Empty where events were not lost but lie in other pixels.
    """
    if lost.elsewhere:
        return []
    about = ((_event_before(a, events), _event_after(b, events)) for a, b in lost.spans_us)
    return list(_joined(about))


def unrecorded_spans(pairs: Sequence[FramePair], events: EventStore) -> list[Span]:
    """From the first mid-exposure to the first event, and from the last event to the last
    mid-exposure, where the sensor was not recorded yet or no more.

    Somebody who stands still makes no events either. But then what changes between the frames
    beside changed while events came; of a recorder that started late they tell less of it than of
    any other pair. ``pairs`` in order of time, neither of them across what may not be read.
    """
    first, last = events.time_range_us
    late = [one for one in pairs if sum(one.before_us) // 2 < first]
    early = [one for one in pairs if sum(one.after_us) // 2 > last]
    if not late and not early:
        return []
    others = (one for one in pairs if one not in late and one not in early)
    usual = [told for told in (_told(one, events) for one in others) if told is not None]
    if len(usual) < _FEWEST_OTHERS:
        return []
    limit = min(_TOLD * float(np.median(usual)), *usual)
    spans = []
    if _any_below(limit, late, events):
        spans.append((sum(late[0].before_us) // 2 - 1, first))
    if _any_below(limit, early, events):
        spans.append((last, sum(early[-1].after_us) // 2 + 1))
    return spans


def _any_below(limit: float, pairs: Iterable[FramePair], events: EventStore) -> bool:
    shares = (_told(one, events) for one in pairs)
    return any(share is not None and share < limit for share in shares)


def _told(pair: FramePair, events: EventStore) -> float | None:
    """Events per change of log luminance at the pixels that change much; None where few do."""
    moved = _moved(pair, MUCH)
    if moved.sum() < LEAST_PIXELS:
        return None
    change = np.where(moved, pair.change - pair.camera_change, 0.0)
    (start, end), (low, high) = pair.span_us, pair.recorded_us
    start = max(start, low)
    near = events.between(start, max(start, min(end, high)))
    way = np.sign(change).reshape(-1)[event_pixels(near, *change.shape)]
    agrees = way * near.p if events.has_polarity else np.abs(way)
    return float((pair.weights(near.t) * agrees).sum() / np.abs(change).sum())


def _joined(spans_us: Iterable[Span]) -> tuple[Span, ...]:
    """Spans in order of their starts, those put together that meet."""
    found: list[Span] = []
    for start, end in spans_us:
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return tuple(found)


def pauses(
    spans_us: Sequence[Span], stretch: Sequence[Span], events: EventStore
) -> list[tuple[int, int]]:
    """Numbers of frames between which next to no event came, so that pictures are to be asked.

    ``spans_us`` are exposures in order and ``stretch`` the readable stretch of each. All of them
    are looked at, by counts of events alone. A pause of several frames is two pairs, to its middle
    and from there: somebody who goes to and fro may be back at its end. Of many pauses those are
    taken that most events came beside: of who comes to rest they grow fewer, a stall comes at once.
    """
    if len(spans_us) < 2:
        return []
    exposed, readable = np.array(spans_us), np.array(stretch)
    start = np.minimum(exposed[:-1, 0], exposed[1:, 0])
    end = np.maximum(exposed[:-1, 1], exposed[1:, 1])
    first, last = events.time_range_us
    told = (readable[:-1] == readable[1:]).all(1)
    told &= start >= np.maximum(first, readable[:-1, 0])
    told &= end <= np.minimum(last, readable[:-1, 1])
    if not told.any():
        return []
    counts = np.zeros(len(start), np.int64)
    counts[told] = events.counts(np.stack([start[told], end[told]], axis=-1))
    rate = counts / (end - start)
    silent = told & (rate <= _NEXT_TO_NONE * np.median(rate[told]))
    # Where silence begins, and one past its end.
    begun, over = (
        np.flatnonzero(np.diff(silent.astype(np.int8), prepend=0, append=0) == step)
        for step in (1, -1)
    )
    until = np.concatenate([[0], np.cumsum(counts)])
    before = until[begun] - until[np.maximum(begun - _BESIDE, 0)]
    after = until[np.minimum(over + _BESIDE, len(counts))] - until[over]
    chosen = np.sort(np.argsort(-(before + after), kind="stable")[:_MOST_PAUSES])
    found = []
    for low, high in zip(begun[chosen].tolist(), over[chosen].tolist(), strict=True):
        middle = (low + high) // 2
        found += [(low, middle), (middle, high)] if middle > low else [(low, high)]
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


def _came(spans_us: Sequence[Span], events: EventSource) -> tuple[int, float]:
    """Number of events during spans, all pixels together, and their rate per microsecond."""
    count = sum(len(events.between(*span)) for span in spans_us)
    return count, count / max(1, sum(end - start for start, end in spans_us))


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
