"""Lag of the events' clock behind the frames', from how well both agree on the changes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from evsplat.calibration.brightness import EventSource, FramePair, PairEvents
from evsplat.calibration.peak import top_near

SEARCH_US = 100_000
"""Lags up to here, either way, are tried."""
LEAST_PIXELS = 300
"""Fewer active pixels give no correlation."""
LEAST_CORRELATION = 0.3
MOST_LAG_US = 4_000
"""Events are late by a few ms by their nature; clocks that differ by more are reported."""
SLOW_MOTION_US = 5_500
"""Where all that moves is slow events are later than their clock by so much at most, as pixels wait
for a threshold: measured (docs/clock-and-thresholds.md), and in no standard error, since all parts
of a recording are late together."""
_GROUPS = 8
_FEWEST_MOVING = 4
"""Pairs of frames, counted by what each tells, below which they say nothing of an error: a step
that somebody makes in a still recording is a single observation, however much is compared."""


@dataclass(frozen=True, eq=False)
class ClockEstimate:
    """Agreement of frames and events by the shift between their clocks."""

    lag_us: float
    """Events are stamped this much later than the frames: subtract it from their times."""
    spread_us: float
    """Standard error of ``lag_us`` over the recording (jackknife over groups of frames), without
    what `SLOW_MOTION_US` says; NaN where something moves in too few frames to tell it."""
    correlation: float
    """Pearson's, of log luminance change and signed event count at ``lag_us``."""
    lags_us: Float[np.ndarray, "L"]
    correlations: Float[np.ndarray, "L"]
    """The correlation at each of ``lags_us``."""

    @property
    def differs(self) -> bool:
        """True where events and frames are surely not on one clock."""
        return abs(self.lag_us) > MOST_LAG_US and abs(self.lag_us) > 3 * self.spread_us

    def __str__(self) -> str:
        """What the events do, in words."""
        way = "lag" if self.lag_us > 0 else "lead"
        return f"events {way} the frames by {abs(self.lag_us) / 1000:.1f} ms"


def estimate_clock(pairs: Sequence[FramePair], events: EventSource) -> ClockEstimate | None:
    """The lag at which what events add up to correlates best with the change between frames.

    The correlation is taken over the pixels with events, of all pairs together; a parabola through
    its largest values gives the lag between the steps of the search. None where too little moves,
    or frames and events have nothing to do with each other. Pairs whose events at a lag were
    not recorded or may not be read are left out there.
    """
    if not pairs:
        return None
    step = max(500.0, float(np.median([pair.gap_us for pair in pairs])) / 4)
    coarse = np.arange(-round(SEARCH_US / step), round(SEARCH_US / step) + 1) * step
    sums = _moments(pairs, events, coarse)
    best = _best(_correlation(sums.sum(0)))
    if best is None:
        return None
    fine = coarse[best] + np.linspace(-1, 1, 13) * step
    fine_sums = _moments(pairs, events, fine)
    correlations = _correlation(fine_sums.sum(0))
    vertex = _vertex(fine, correlations)
    if vertex is None or np.nanmax(correlations) < LEAST_CORRELATION:
        return None
    beyond = (coarse < fine[0]) | (coarse > fine[-1])
    lags = np.concatenate([coarse[beyond], fine])
    order = np.argsort(lags, kind="stable")
    curve = np.concatenate([_correlation(sums.sum(0))[beyond], correlations])
    return ClockEstimate(
        lag_us=vertex,
        spread_us=_jackknife(fine, fine_sums),
        correlation=float(np.nanmax(correlations)),
        lags_us=lags[order],
        correlations=curve[order],
    )


def correlations_at(
    pairs: Sequence[FramePair], events: EventSource, lags_us: Float[np.ndarray, "L"]
) -> Float[np.ndarray, "L"]:
    """Correlation of frames and events at ascending lags; NaN where too little is there."""
    return _correlation(_moments(pairs, events, lags_us).sum(0))


def _moments(
    pairs: Sequence[FramePair],
    events: EventSource,
    lags_us: Float[np.ndarray, "L"],
) -> Float[np.ndarray, "P L 6"]:
    """Per pair and lag: count, sums of N, D, N^2, D^2 and ND over usable pixels with events."""
    sums = np.zeros((len(pairs), len(lags_us), 6))
    for row, pair in zip(sums, pairs, strict=True):
        near = PairEvents(pair, events, (lags_us[0], lags_us[-1]))
        for values, lag in zip(row, lags_us, strict=True):
            if not pair.recorded_at(lag):
                continue
            level, active = near.level_change(lag)
            active &= near.usable
            n, d = level[active], near.change[active]
            values[:] = len(n), n.sum(), d.sum(), n @ n, d @ d, n @ d
    return sums


def _correlation(sums: Float[np.ndarray, "L 6"]) -> Float[np.ndarray, "L"]:
    """Pearson's correlation; NaN where there are too few pixels."""
    count, n, d, nn, dd, nd = sums.T
    with np.errstate(all="ignore"):
        variances = (nn - n * n / count) * (dd - d * d / count)
        found = (nd - n * d / count) / np.sqrt(variances)
    # Lags that leave out most of the recording would win by chance.
    few = (count < LEAST_PIXELS) | (count < 0.3 * count.max())
    return np.where(few, np.nan, found)


def _best(correlations: Float[np.ndarray, "L"]) -> int | None:
    return None if np.isnan(correlations).all() else int(np.nanargmax(correlations))


def _vertex(lags_us: Float[np.ndarray, "L"], correlations: Float[np.ndarray, "L"]) -> float | None:
    """Lag at the top of the correlations."""
    best = _best(correlations)
    if best is None:
        return None
    return float(lags_us[0] + top_near(correlations, best) * (lags_us[1] - lags_us[0]))


def _jackknife(lags_us: Float[np.ndarray, "L"], sums: Float[np.ndarray, "P L 6"]) -> float:
    """Standard error of the vertex when one group of neighbouring pairs at a time is left out.

    Groups tell as much as each other: of such with an equal number of pairs, all but one may hold
    noise alone, and agree with each other on what that one says.
    """
    total = sums.sum(0)
    told = _told(sums[:, np.nanargmax(_correlation(total))])
    if told.sum() ** 2 < _FEWEST_MOVING * (told**2).sum():
        return float("nan")
    group = (_GROUPS * (np.cumsum(told) - told / 2) / told.sum()).astype(int)
    found = [
        _vertex(lags_us, _correlation(total - sums[group == g].sum(0))) for g in np.unique(group)
    ]
    values = np.array([value for value in found if value is not None])
    if len(values) < 2:
        return float("nan")
    count = len(values)
    return float(np.sqrt((count - 1) / count * ((values - values.mean()) ** 2).sum()))


def _told(sums: Float[np.ndarray, "P 6"]) -> Float[np.ndarray, "P"]:
    """What each pair adds to the correlation; next to nothing where noise alone sent events."""
    count, n, d, _, _, nd = sums.T
    return np.maximum(0.0, nd - n * d / np.maximum(count, 1))
