"""Contrast thresholds C+ and C- of an event sensor, fitted to the change between frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from evsplat.calibration.brightness import EventSource, FramePair, PairEvents

LEAST_EVENTS = 300
"""Least events of either polarity that a threshold is fitted to."""
SEVERAL = 1.5
"""Events of a pixel, weighed by the exposures, that no noise makes between two frames: where little
of a picture moves, most of its single events tell of no change."""
LOWEST = 0.01
"""No sensor's threshold; what is fitted to noise alone."""
_HUBER = 1.345
_ITERATIONS = 30


@dataclass(frozen=True)
class ThresholdEstimate:
    """C+ and C- in natural logarithm of intensity per event."""

    plus: float
    minus: float
    residual: float
    """Robust standard deviation of a pixel's change from the fit, in log intensity."""
    pixels: int
    """Pixels with events, over all pairs of frames, that the fit is made of."""


def estimate_thresholds(
    pairs: Sequence[FramePair],
    events: EventSource,
    lag_us: float = 0.0,
) -> ThresholdEstimate | None:
    """Fit ``change = C+ n+ - C- n-`` over the pixels with events; None where those are too few.

    Those with `SEVERAL` events count, and where these are too few all with any.

    The fit is Huber's robust regression (weight 1 up to 1.345 standard deviations of the rest),
    because pixels miss events and frames clip. It gives the change that one event stands for, on
    average: a little less than the sensor's threshold where most pixels fire only once or twice,
    and more where pixels stop short of the next event.
    """
    counts, changes = [np.zeros((0, 2))], [np.zeros(0)]
    for pair in pairs:
        if not pair.recorded_at(lag_us):
            continue
        near = PairEvents(pair, events, (lag_us, lag_us))
        plus, minus = near.counts(lag_us)
        active = near.usable & (plus + minus > 0)
        counts.append(np.stack([plus[active], -minus[active]], axis=-1))
        changes.append(near.change[active])
    design, change = np.concatenate(counts), np.concatenate(changes)
    several = np.abs(design).sum(1) >= SEVERAL
    if _enough(design[several]):
        design, change = design[several], change[several]
    elif not _enough(design):
        return None
    (plus_c, minus_c), residual = _huber(design, change)
    if min(plus_c, minus_c) < LOWEST:
        return None
    return ThresholdEstimate(float(plus_c), float(minus_c), residual, len(change))


def _enough(design: Float[np.ndarray, "N 2"]) -> bool:
    """Whether there are events of either polarity to fit to."""
    return bool((np.abs(design).sum(0) >= LEAST_EVENTS).all())


def _huber(
    design: Float[np.ndarray, "N 2"], target: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Robust least squares by reweighting, and the residuals' standard deviation (from the MAD)."""
    weights = np.ones(len(target))
    solution, scale = np.zeros(2), 0.0
    for _ in range(_ITERATIONS):
        weighted = design * weights[:, None]
        before = solution
        solution = np.linalg.lstsq(weighted.T @ design, weighted.T @ target, rcond=None)[0]
        residual = target - design @ solution
        scale = 1.4826 * float(np.median(np.abs(residual)))
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residual), 1e-12))
        if np.abs(solution - before).max() < 1e-6:
            break
    return solution, scale
