"""The event camera as training of method `evsplat` begins with it: thresholds, clock and noise."""

import logging

import torch

from evsplat.calibration import SensorEstimate, unrecorded_spans, untold_spans
from evsplat.capture import TrainingCapture, estimate_sensor, lost_events
from evsplat.capture.sensor_estimate import frame_pairs
from evsplat.events import EventStore, Span
from evsplat.methods.base import Purpose
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.models.discs import DiscModel
from evsplat.objectives import EventNoise, EventSensor, EventWindows

logger = logging.getLogger(__name__)

UNKNOWN_THRESHOLD = 0.2
"""Contrast threshold to start from where neither the capture nor its frames tell one."""


def event_windows(
    config: EvsplatConfig,
    capture: TrainingCapture,
    model: DiscModel,
    generator: torch.Generator,
    *,
    device: torch.device | str,
    purpose: Purpose,
) -> tuple[EventWindows, bool]:
    """The event term, and whether its thresholds were given or found, where it starts to learn.

    The sensor with its thresholds and clock becomes a part of ``model``.
    """
    assert capture.events is not None
    # A loaded model brings its own.
    known, late_us = None, None
    if purpose == "train":
        estimate = None
        if capture.contrast_threshold is None or config.clock != "never":
            estimate = estimate_sensor(capture)
        known = _thresholds(capture, estimate)
        late_us = _late_us(config, estimate)
        if not capture.events.has_polarity:
            logger.warning(
                "%s: its events have no polarity; the size of changes is compared with their "
                "number.", capture.path,
            )  # fmt: skip
    start = known or (UNKNOWN_THRESHOLD, UNKNOWN_THRESHOLD)
    sensor = EventSensor(*start, late_us=late_us).to(device)
    model.sensor = sensor
    flicker_us = 0 if purpose == "draw" else capture.flicker_us
    # All of a flickering picture sends events that nothing moves; they are averaged out instead.
    aware = config.event_noise_aware and not flicker_us
    noise = EventNoise(capture.events, during_us=capture.minute_around_us, aware=aware)
    if purpose != "draw":
        noise.measure()
    windows = EventWindows(
        capture,
        sensor,
        generator,
        start=config.event_start,
        eps=config.event_eps,
        noise=noise,
        reach=config.event_reach,
        ramp_us=config.event_ramp_us,
        hue_from=config.event_hue_from,
        flicker_us=flicker_us,
        untold_us=[] if purpose == "draw" else _untold_us(capture, capture.events),
    )
    return windows, known is not None


def _untold_us(capture: TrainingCapture, events: EventStore) -> list[Span]:
    """When the sensor lost its events, or was not recorded yet or no more."""
    lost = untold_spans(lost_events(capture), events)
    spans = sorted([*lost, *unrecorded_spans(frame_pairs(capture), events)])
    for start, end in spans:
        logger.info(
            "no event from %.3f to %.3f s, where pictures change: learned from frames alone there",
            start / 1e6, end / 1e6,
        )  # fmt: skip
    return spans


def _late_us(config: EvsplatConfig, estimate: SensorEstimate | None) -> float | None:
    """Start of the learned offset of the events' clock; None: not learned."""
    if config.clock == "never":
        return None
    if estimate is None or not estimate.clock.differs:
        return 0.0 if config.clock == "always" else None
    logger.info("%s; the offset of their clock is learned", estimate.clock)
    return estimate.clock.lag_us


def _thresholds(
    capture: TrainingCapture, estimate: SensorEstimate | None
) -> tuple[float, float] | None:
    """C+ and C-: the capture's, or those at which training frames and events agree best, if any."""
    if capture.contrast_threshold is not None:
        return capture.contrast_threshold
    if estimate is None or estimate.thresholds is None:
        logger.warning(
            "%s: contrast thresholds are neither given nor to be found from frames and events; "
            "starting from %g.", capture.path, UNKNOWN_THRESHOLD,
        )  # fmt: skip
        return None
    found = estimate.thresholds
    logger.info("contrast thresholds found: C+ %.3f, C- %.3f", found.plus, found.minus)
    return found.plus, found.minus
