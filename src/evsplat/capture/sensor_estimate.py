"""Clock and contrast thresholds of a capture's event sensor, from its frames and events."""

import logging

from evsplat.calibration import (
    MOST_PAIRS,
    FramePair,
    SensorEstimate,
    estimate_from_pairs,
    exposure,
    pair,
    pair_indices,
)
from evsplat.capture.capture import Capture
from evsplat.capture.training_capture import TrainingCapture

logger = logging.getLogger(__name__)


LIKELY_LARGEST = 0.6
"""Sensors' thresholds lie between 0.1 and 0.5; frames that are light and are taken as coded by the
power curve make them look 2.2 times as large."""


def looks_linear(capture: Capture | TrainingCapture, estimate: SensorEstimate | None) -> bool:
    """True where fitted thresholds are so large that the frames are likely to hold linear light."""
    if estimate is None or estimate.thresholds is None:
        return False
    fitted = estimate.thresholds
    coded = capture.transfer(capture.frames[0]) != "linear"
    return coded and (fitted.plus + fitted.minus) / 2 > LIKELY_LARGEST


def warn_of_linear_frames(capture: TrainingCapture, estimate: SensorEstimate | None) -> None:
    """Log that frames look linear where their values are taken as coded."""
    if looks_linear(capture, estimate):
        assert estimate is not None and estimate.thresholds is not None
        fitted = estimate.thresholds
        logger.warning(
            "%s: the contrast fitted to frames and events is %.2f / %.2f, expected 0.1 to 0.5: the "
            'frames look linear; if they are, write "transfer": "linear" into their camera.',
            capture.path / "capture.json",
            fitted.plus,
            fitted.minus,
        )


def estimate_sensor(capture: TrainingCapture) -> SensorEstimate | None:
    """Estimate from at most 60 pairs of consecutive frames; None where that is not possible.

    Pairs are of training frames with no held-out one between them. Events without polarity tell
    nothing.

    The lag is what is left after the capture's own ``clock_offset_us``. A moving camera changes
    nothing: both sides see what moves in the picture.
    """
    if capture.events is None or len(capture.events) == 0 or not capture.events.has_polarity:
        return None
    return estimate_from_pairs(frame_pairs(capture), capture.events)


def frame_pairs(capture: TrainingCapture) -> list[FramePair]:
    """At most 60 pairs of consecutive training frames with no held-out one between them."""
    assert capture.events is not None
    first, last = capture.events.time_range_us
    frames = capture.train_frames
    spans = [frame.exposure_us for frame in frames]
    stretch = [capture.events.readable_around(frame.mid_us) for frame in frames]
    pairs = []
    for both in pair_indices(spans, MOST_PAIRS, stretch=stretch):
        start, end = stretch[both[0]]
        before, after = (
            exposure(capture.image(frames[i]), spans[i], transfer=capture.transfer(frames[i]))
            for i in both
        )
        pairs.append(pair(before, after, (max(start, first), min(end, last))))
    return pairs
