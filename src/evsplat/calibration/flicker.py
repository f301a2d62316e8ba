"""Lamps that flicker with the mains: their period, by events of both signs all over the picture."""

import numpy as np
from jaxtyping import Float

from evsplat.events import EventStore, EventStream
from evsplat.events.store import ALWAYS, Span

_STEP_US = 250
_SMOOTH = 9
"""Steps over which the signal is smoothed: lamps that go on at once do so between two steps."""
_SHORTEST_US, _LONGEST_US = 3_000, 25_000
"""Of periods: lamps flicker with twice the 50 or 60 Hz of the mains, dimmed ones up to 300 Hz."""
_ALIKE = 0.5
"""Least correlation of what flickers with itself a period later."""
_AS_MUCH = 0.8
"""Share of the highest correlation that the first period's is at least."""
_LEAST_SHARE = 0.25
"""Events of either sign that half of the pixels send in a period at least, on average."""
_PIECE_US, _LEAST_US = 200_000, 50_000
"""Length of the pieces that are looked at, and the least of what is held out in between leaves."""
_MOST_PIECES, _MOST_EVENTS = 60, 20_000_000
"""Of a busy recording one piece at least is looked at."""


def flicker_period_us(events: EventStore, during_us: Span = ALWAYS) -> int | None:
    """Period of lamps by whose light half of the picture sends events, microseconds; None: none.

    Looked at is what may be read of a recording, or of a part of it, in pieces spread over it. What
    moves, a camera too, sends events of both signs much more seldom than lamps flicker, and not in
    step.
    """
    if not events.has_polarity:
        return None
    lags = _LONGEST_US // _STEP_US + 2
    alike, seen_us = np.zeros(lags), 0
    counts = np.zeros((2, events.height * events.width), np.int64)
    for start, end in _pieces(events, during_us):
        stream = events.between(start, end)
        signal = _signal(stream, start, (end - start) // _STEP_US)
        compared = signal[: len(signal) - lags]
        alike += [float(compared @ signal[lag : lag + len(compared)]) for lag in range(lags)]
        place = stream.y.astype(np.int64) * events.width + stream.x
        for count, side in zip(counts, (stream.p > 0, stream.p < 0), strict=True):
            count += np.bincount(place[side], minlength=len(count))
        seen_us += end - start
    period_us = _period_us(alike)
    if period_us is None:
        return None
    in_a_period = float(np.median(counts.min(0))) * period_us / seen_us
    return period_us if in_a_period >= _LEAST_SHARE else None


def _pieces(events: EventStore, during_us: Span) -> list[Span]:
    """Stretches to read, in order of time, each within what may be read."""
    within = [
        (max(start, during_us[0]), min(end, during_us[1])) for start, end in events.stretches_us
    ]
    pieces = [
        (first, min(first + _PIECE_US, end))
        for start, end in within
        for first in range(start, end - _LEAST_US + 1, _PIECE_US)
    ]
    whole_us = max(1, sum(end - start for start, end in events.stretches_us))
    of_a_piece = max(1.0, len(events) * _PIECE_US / whole_us)
    most = min(_MOST_PIECES, max(1, int(_MOST_EVENTS / of_a_piece)))
    if len(pieces) <= most:
        return pieces
    chosen = (np.arange(most) + 0.5) * len(pieces) / most
    return [pieces[int(index)] for index in chosen]


def _signal(stream: EventStream, start_us: int, steps: int) -> Float[np.ndarray, "S"]:
    """Sum of polarities about each step, less its mean."""
    step = (stream.t - start_us) // _STEP_US
    sums = np.bincount(step, stream.p, steps)[:steps]
    return np.convolve(sums - sums.mean(), np.hanning(_SMOOTH), mode="same")


def _period_us(alike: Float[np.ndarray, "L"]) -> int | None:
    """Where a signal is like itself again after it was like its opposite."""
    opposite = np.flatnonzero(alike < 0)
    if not len(opposite):
        return None
    first = max(_SHORTEST_US // _STEP_US, int(opposite[0]))
    before, at, after = alike[first - 1 : -2], alike[first:-1], alike[first + 1 :]
    peaks = np.flatnonzero((at >= before) & (at > after) & (at >= _ALIKE * alike[0]))
    if not len(peaks):
        return None
    # It is like itself after two periods as well, and no less by much.
    peak = first + int(peaks[at[peaks] >= _AS_MUCH * at[peaks].max()][0])
    before, at, after = alike[peak - 1 : peak + 2]
    # The highest point of the parabola through three: steps are coarse.
    further = 0.5 * (before - after) / (before - 2 * at + after)
    return round((peak + further) * _STEP_US)
