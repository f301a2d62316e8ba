"""Clock offset, contrast thresholds and noise of an event sensor, from what it recorded."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from evsplat.calibration.brightness import (
    EventSource,
    Exposure,
    FramePair,
    exposure,
    pair,
    pair_indices,
)
from evsplat.calibration.clock import ClockEstimate, estimate_clock
from evsplat.calibration.noise import NoiseEstimate, NoiseMeter, noise_of
from evsplat.calibration.thresholds import ThresholdEstimate, estimate_thresholds

if TYPE_CHECKING:
    from evsplat.capture import TrainingCapture

__all__ = [
    "ClockEstimate",
    "Exposure",
    "FramePair",
    "NoiseEstimate",
    "NoiseMeter",
    "SensorEstimate",
    "ThresholdEstimate",
    "estimate_clock",
    "estimate_from_capture",
    "estimate_from_pairs",
    "estimate_thresholds",
    "noise_of",
    "exposure",
    "pair",
    "pair_indices",
]

MOST_PAIRS = 60


@dataclass(frozen=True)
class SensorEstimate:
    """What frames tell about the events that were recorded with them."""

    clock: ClockEstimate
    thresholds: ThresholdEstimate | None
    """Fitted at the estimated lag; None where there are too few events of either polarity."""


def estimate_from_pairs(pairs: Sequence[FramePair], events: EventSource) -> SensorEstimate | None:
    """Clock lag, then thresholds at that lag; None where frames and events do not correlate."""
    clock = estimate_clock(pairs, events)
    if clock is None:
        return None
    return SensorEstimate(clock, estimate_thresholds(pairs, events, clock.lag_us))


def estimate_from_capture(capture: "TrainingCapture") -> SensorEstimate | None:
    """Estimate from at most 60 pairs of consecutive frames; None where that is not possible.

    Pairs are of training frames with no held-out one between them. Events without polarity tell
    nothing.

    The lag is what is left after the capture's own ``clock_offset_us``. A moving camera changes
    nothing: both sides see what moves in the picture.
    """
    if capture.events is None or len(capture.events) == 0 or not capture.events.has_polarity:
        return None
    first, last = capture.events.time_range_us
    frames = capture.train_frames
    spans = [frame.exposure_us for frame in frames]
    stretch = [capture.events.open_around(frame.mid_us) for frame in frames]
    pairs = []
    for both in pair_indices(spans, MOST_PAIRS, stretch=stretch):
        start, end = stretch[both[0]]
        before, after = (exposure(capture.image(frames[i]), spans[i]) for i in both)
        pairs.append(pair(before, after, (max(start, first), min(end, last))))
    return estimate_from_pairs(pairs, capture.events)
