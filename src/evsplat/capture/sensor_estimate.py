"""Clock and contrast thresholds of a capture's event sensor, from its frames and events."""

from evsplat.calibration import (
    MOST_PAIRS,
    SensorEstimate,
    estimate_from_pairs,
    exposure,
    pair,
    pair_indices,
)
from evsplat.capture.training_capture import TrainingCapture


def estimate_sensor(capture: TrainingCapture) -> SensorEstimate | None:
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
    stretch = [capture.events.readable_around(frame.mid_us) for frame in frames]
    pairs = []
    for both in pair_indices(spans, MOST_PAIRS, stretch=stretch):
        start, end = stretch[both[0]]
        before, after = (exposure(capture.image(frames[i]), spans[i]) for i in both)
        pairs.append(pair(before, after, (max(start, first), min(end, last))))
    return estimate_from_pairs(pairs, capture.events)
