"""Words for an event sensor's clock and thresholds, and the warnings about them."""

import math

from evsplat.calibration import ClockEstimate, SensorEstimate, ThresholdEstimate
from evsplat.capture.capture import Capture
from evsplat.capture.finding import Finding, Findings
from evsplat.capture.sensor_estimate import looks_linear

_LEAST_FITTED = 1_000
"""Pixels with events of which fitted thresholds contradict given ones."""
_FAR_APART = 1.6
"""Fitted ones are up to 1.3 times the known where exposures overlap, and within 0.1 elsewhere."""


def sensor_lines(
    estimate: SensorEstimate | None, clock_offset_us: int, *, has_polarity: bool
) -> list[str]:
    """Clock and contrast in words; ``clock_offset_us`` is what was added to the events' times."""
    if estimate is None and not has_polarity:
        return ["clock      not estimated: events without polarity say nothing of which way"]
    if estimate is None:
        return [
            "clock      not estimated: too little moves, the pictures are too dark, or the clocks "
            "differ by more than 0.1 s (evsplat import finds that: --clock-offset-us auto)"
        ]
    clock, contrast = estimate.clock, estimate.thresholds
    unknown = math.isnan(clock.spread_us)
    doubt = "too little moves to tell an error" if unknown else f"+-{clock.spread_us / 1000:.1f} ms"
    text = f"clock      events {_lag_text(clock)} ({doubt}; correlation {clock.correlation:.2f})"
    if clock.differs:
        text += f"; clock_offset_us {_aligning_us(clock, clock_offset_us)} would align them"
    lines = [text]
    if contrast is not None:
        lines.append(
            f"contrast   C+ {contrast.plus:.3f}, C- {contrast.minus:.3f} fitted "
            f"({contrast.pixels:,} pixels, residual {contrast.residual:.2f})"
        )
    return lines


def _lag_text(clock: ClockEstimate) -> str:
    return (
        f"{'lag' if clock.lag_us > 0 else 'lead'} the frames by {abs(clock.lag_us) / 1000:.1f} ms"
    )


def _aligning_us(clock: ClockEstimate, clock_offset_us: int) -> int:
    """A lag is taken back by an offset of the other sign."""
    return 100 * round((clock_offset_us - clock.lag_us) / 100)


def clock_findings(capture: Capture, estimate: SensorEstimate | None) -> list[Finding]:
    """A warning where the estimated clock is far from what capture.json says."""
    if estimate is None or not estimate.clock.differs:
        return []
    findings = Findings()
    findings.warning(
        capture.path / "capture.json",
        "events.clock_offset_us",
        f"{capture.clock_offset_us}, with which events {_lag_text(estimate.clock)}",
        "events and frames on one clock",
        f"Try {_aligning_us(estimate.clock, capture.clock_offset_us)}.",
    )
    return findings.items


def contrast_findings(capture: Capture, estimate: SensorEstimate | None) -> list[Finding]:
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
