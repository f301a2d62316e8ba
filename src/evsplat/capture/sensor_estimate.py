"""Clock and contrast thresholds of a capture's event sensor, from its frames and events."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache

from evsplat.calibration import (
    MOST_PAIRS,
    Exposure,
    FramePair,
    Lost,
    SensorEstimate,
    ThresholdEstimate,
    estimate_from_pairs,
    exposure,
    find_lost,
    pair,
    pair_indices,
    pauses,
)
from evsplat.capture.capture import Capture
from evsplat.capture.finding import Finding, Findings
from evsplat.capture.training_capture import TrainingCapture
from evsplat.events import Span

logger = logging.getLogger(__name__)


LIKELY_LARGEST = 0.6
"""Sensors' thresholds lie between 0.1 and 0.5; frames that are light and are taken as coded by the
power curve make them look 2.2 times as large."""

_LEAST_FITTED = 1_000
"""Pixels with events of which fitted thresholds contradict given ones."""
_FAR_APART = 1.6
"""Fitted ones are up to 1.3 times the known where exposures overlap, and within 0.1 elsewhere."""

_KEPT_BYTES = 128 << 20
"""Of shared pairs, which are there while a model is built: 60 of 512 x 512 pixels take 79 MB."""


def looks_linear(capture: Capture | TrainingCapture, estimate: SensorEstimate | None) -> bool:
    """True where fitted thresholds are so large that the frames are likely to hold linear light."""
    if estimate is None or estimate.thresholds is None:
        return False
    fitted = estimate.thresholds
    coded = capture.transfer(capture.frames[0]) != "linear"
    return coded and (fitted.plus + fitted.minus) / 2 > LIKELY_LARGEST


def contrast_findings(
    capture: Capture | TrainingCapture, estimate: SensorEstimate | None
) -> list[Finding]:
    """Warnings where the fitted thresholds say that frames hold linear light, or are not the given.

    Thresholds of frames that look linear are far off for that reason, and are not compared.
    """
    if estimate is None or estimate.thresholds is None:
        return []
    fitted, camera, given = (
        estimate.thresholds,
        capture.frames[0].camera,
        capture.contrast_threshold,
    )
    findings = Findings()
    if looks_linear(capture, estimate):
        findings.warning(
            capture.path / "capture.json",
            f"cameras.{camera}.transfer",
            f"{capture.transfer(capture.frames[0])!r}, with which an event stands for a change of "
            f"{fitted.plus:.2f} / {fitted.minus:.2f}: the frames look linear",
            "thresholds of 0.1 to 0.5",
            'Write "linear" if the camera stores light as it measures it, as a DAVIS does.',
        )
    elif given is not None and fitted.pixels >= _LEAST_FITTED and _far_apart(given, fitted):
        findings.warning(
            capture.path / "capture.json",
            "events.contrast_threshold",
            f"{list(given)}, and an event stands for a change of {fitted.plus:.2f} / "
            f"{fitted.minus:.2f} of the frames",
            "thresholds with which events add up to what the frames show",
            "Leave them null to have them found, as where several pixels of the sensor lie in one "
            "of the pictures; if they are known, see whether events are there twice or were "
            "thinned, and which transfer the camera has.",
        )
    return findings.items


def _far_apart(given: tuple[float, float], fitted: ThresholdEstimate) -> bool:
    """True where fitted thresholds are not those given, whatever their fit errs by."""
    ratio = (fitted.plus + fitted.minus) / (given[0] + given[1])
    return not 1 / _FAR_APART < ratio < _FAR_APART


def warn_of_contrast(capture: TrainingCapture, estimate: SensorEstimate | None) -> None:
    """Log `contrast_findings`."""
    for finding in contrast_findings(capture, estimate):
        logger.warning("%s", finding)


def estimate_sensor(capture: TrainingCapture) -> SensorEstimate | None:
    """Estimate from at most 60 pairs of consecutive frames; None where that is not possible.

    Pairs are of training frames with no held-out one between them. Events without polarity tell
    nothing. It is made once of a capture.

    The lag is what is left after the capture's own ``clock_offset_us``. A moving camera changes
    nothing: both sides see what moves in the picture.
    """
    if capture.events is None or len(capture.events) == 0 or not capture.events.has_polarity:
        return None
    if capture.sensor_estimate is None:
        capture.sensor_estimate = (estimate_from_pairs(frame_pairs(capture), capture.events),)
    return capture.sensor_estimate[0]


@contextmanager
def shared_pairs(capture: TrainingCapture) -> Iterator[None]:
    """Within it `frame_pairs` are made once for all who ask, unless they are too large to keep."""
    capture.shared_pairs = []
    try:
        yield
    finally:
        capture.shared_pairs = None


def frame_pairs(capture: TrainingCapture) -> list[FramePair]:
    """At most 60 pairs of consecutive training frames with no held-out one between them.

    Not to be written to, as others may share them.
    """
    if capture.shared_pairs:
        return capture.shared_pairs
    spans, stretch = _exposures(capture)
    pairs = list(_made_pairs(capture, pair_indices(spans, MOST_PAIRS, stretch=stretch)))
    size = sum(one.change.nbytes + one.usable.nbytes for one in pairs)
    if capture.shared_pairs is not None and size <= _KEPT_BYTES:
        capture.shared_pairs = pairs
    return pairs


def lost_events(capture: TrainingCapture, pairs: Sequence[FramePair] | None = None) -> Lost:
    """When events did not tell what changes between training frames, found once of a capture.

    By `frame_pairs`, which miss what is short in a long recording, and by those frames between
    which next to no event came, of all that there are (`pauses`). ``pairs``: the former, where they
    are at hand.
    """
    if capture.lost is None:
        assert capture.events is not None
        silent = _made_pairs(capture, pauses(*_exposures(capture), capture.events))
        pairs = frame_pairs(capture) if pairs is None else pairs
        capture.lost = find_lost(pairs, capture.events, silent)
    return capture.lost


def _exposures(capture: TrainingCapture) -> tuple[list[Span], list[Span]]:
    """Exposures of the training frames, and the readable stretch of events about each."""
    assert capture.events is not None
    frames = capture.train_frames
    stretch = [capture.events.readable_around(frame.mid_us) for frame in frames]
    return [frame.exposure_us for frame in frames], stretch


def _made_pairs(
    capture: TrainingCapture, indices: Iterable[tuple[int, int]]
) -> Iterator[FramePair]:
    """Pairs of training frames by their numbers."""
    assert capture.events is not None
    first, last = capture.events.time_range_us
    frames = capture.train_frames

    # The second frame of a pair is mostly the first one of the next.
    @lru_cache(maxsize=2)
    def exposed(index: int) -> Exposure:
        frame = frames[index]
        span_us, transfer = frame.exposure_us, capture.transfer(frame)
        return exposure(capture.image(frame), span_us, transfer=transfer)

    for before, after in indices:
        start, end = capture.events.readable_around(frames[before].mid_us)
        recorded_us = max(start, first), min(end, last)
        yield pair(exposed(before), exposed(after), recorded_us)
