"""Words for an event sensor's clock and thresholds, and the warning about its clock."""

import math

from evsplat.calibration import ClockEstimate, SensorEstimate
from evsplat.calibration.clock import SLOW_MOTION_US
from evsplat.capture.capture import Capture
from evsplat.capture.finding import Finding, Findings


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
    doubt = "too little moves to tell an error"
    if not unknown:
        doubt = f"+-{clock.spread_us / 1000:.1f} ms from part to part, and up to "
        doubt += f"{SLOW_MOTION_US / 1000:g} too late if all that moves is slow"
    text = f"clock      {clock} ({doubt}; correlation {clock.correlation:.2f})"
    if clock.differs:
        text += f"; clock_offset_us {_aligning_us(clock, clock_offset_us)} would align them"
    lines = [text]
    if contrast is not None:
        lines.append(
            f"contrast   C+ {contrast.plus:.3f}, C- {contrast.minus:.3f} fitted "
            f"({contrast.pixels:,} pixels, residual {contrast.residual:.2f})"
        )
    return lines


def _aligning_us(clock: ClockEstimate, clock_offset_us: int) -> int:
    """A lag is taken back by an offset of the other sign."""
    return 100 * round((clock_offset_us - clock.lag_us) / 100)


def clock_findings(capture: Capture, estimate: SensorEstimate | None) -> list[Finding]:
    """A warning where the estimated clock is far from what capture.json says."""
    if estimate is None or not estimate.clock.differs:
        return []
    findings, aligning = Findings(), _aligning_us(estimate.clock, capture.clock_offset_us)
    findings.warning(
        capture.path / "capture.json",
        "events.clock_offset_us",
        f"{capture.clock_offset_us}, with which {estimate.clock}",
        "events and frames on one clock",
        f"Write {aligning} there, or import again with --clock-offset-us {aligning}.",
    )
    return findings.items
