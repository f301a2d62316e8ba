"""Clock offset, contrast thresholds and noise of an event sensor, and gains of the frames beside
it, from what was recorded.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from evsplat.calibration.agreement import Disagreement, estimate_disagreement
from evsplat.calibration.brightness import (
    EventSource,
    Exposure,
    FramePair,
    exposure,
    pair,
    pair_indices,
)
from evsplat.calibration.clock import ClockEstimate, estimate_clock
from evsplat.calibration.dead_lines import dead_lines_text, dead_rows
from evsplat.calibration.flicker import flicker_period_us
from evsplat.calibration.lost import (
    Lost,
    answered_share,
    find_lost,
    pauses,
    unrecorded_spans,
    untold_spans,
)
from evsplat.calibration.noise import NoiseEstimate, NoiseMeter, noise_of
from evsplat.calibration.placement import Placement, estimate_placement
from evsplat.calibration.thresholds import ThresholdEstimate, estimate_thresholds

__all__ = [
    "ClockEstimate",
    "Disagreement",
    "EventSource",
    "Exposure",
    "FramePair",
    "Lost",
    "NoiseEstimate",
    "NoiseMeter",
    "Placement",
    "SensorEstimate",
    "ThresholdEstimate",
    "answered_share",
    "dead_lines_text",
    "dead_rows",
    "estimate_disagreement",
    "estimate_from_pairs",
    "estimate_placement",
    "find_lost",
    "flicker_period_us",
    "noise_of",
    "exposure",
    "pair",
    "pair_indices",
    "pauses",
    "unrecorded_spans",
    "untold_spans",
]

MOST_PAIRS = 60


@dataclass(frozen=True)
class SensorEstimate:
    """Clock and thresholds of events, estimated from the frames recorded with them."""

    clock: ClockEstimate
    thresholds: ThresholdEstimate | None
    """Fitted at the estimated lag; None where there are too few events of either polarity."""


def estimate_from_pairs(pairs: Sequence[FramePair], events: EventSource) -> SensorEstimate | None:
    """Clock lag, then thresholds at that lag; None where frames and events do not correlate."""
    clock = estimate_clock(pairs, events)
    if clock is None:
        return None
    return SensorEstimate(clock, estimate_thresholds(pairs, events, clock.lag_us))
