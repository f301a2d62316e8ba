"""Warnings about events that do not tell what frames show: turned, inverted, sparse, lost."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from evsplat.calibration import (
    Disagreement,
    FramePair,
    Lost,
    Placement,
    answered_share,
    estimate_disagreement,
    estimate_placement,
)
from evsplat.capture import TrainingCapture, estimate_sensor, lost_events, warn_of_contrast
from evsplat.capture.finding import Finding, Findings
from evsplat.capture.sensor_estimate import frame_pairs
from evsplat.commands import command
from evsplat.events import EventStore
from evsplat.wording import begun

logger = logging.getLogger(__name__)

_WHICH_WAY = ("events/p", "events/x, events/y")
"""Fields of findings with which events tell nothing of the clock or of thresholds."""
_FEWEST_ANSWERED = 0.7
"""Share of pixels that change very much below which they are not those of the events."""
_MANY = 100
"""Events of which some are of either polarity."""


@dataclass(frozen=True)
class EventCheck:
    """What is wrong with events that are there and readable."""

    findings: list[Finding]
    mendable: Placement | Disagreement | None = None
    """Where they lie, if it is not in the pictures' pixels and a homography brings them back."""


def event_findings(capture: TrainingCapture) -> list[Finding]:
    """The findings of `check_events`."""
    return check_events(capture).findings


def check_events(capture: TrainingCapture, homography: Path | None = None) -> EventCheck:
    """Compare events with what frames show.

    Where they lie beside the pictures, turned or mirrored, the finding tells what to type; that
    takes a file with the homography of what is mendable, which whoever calls writes at
    ``homography``, or `evsplat inspect`.

    Compared are at most 60 pairs of frames with the events between them, so that of a
    long recording a part is looked at; pauses of the events are found wherever they are. Without
    polarity events do not tell whether they are turned.
    """
    findings = Findings()
    events = capture.events
    if events is None or not len(events):
        return EventCheck([])
    pairs, signed = frame_pairs(capture), events.has_polarity
    sign = _only_sign(pairs, events) if signed else ""
    other_way = estimate_disagreement(pairs, events) if signed and not sign else None
    if sign:
        findings.warning(
            events.path, _WHICH_WAY[0], f"{sign} events alone between all frames",
            "events of either polarity, as every motion makes them",
            "Check how the recording was exported, and the sensor's biases.",
        )  # fmt: skip
    elif other_way is not None:
        findings.warning(
            events.path, _WHICH_WAY[bool(other_way.turned)],
            str(other_way), "events in the pixels of the frames, 1 where it grows brighter",
            begun(_way_there(capture, events, other_way, homography)),
        )  # fmt: skip
    asked = signed and not sign and other_way is None
    beside = estimate_placement(pairs, events) if asked else None
    if beside is not None:
        findings.warning(
            events.path, _WHICH_WAY[1],
            f"events that lie beside what changes in the pictures: {beside}",
            "events in the pixels of the pictures",
            "Where something at another distance is in its place, the two lenses stand too far "
            f"apart; else {_way_there(capture, events, beside, homography)}",
        )  # fmt: skip
    elsewhere = other_way is not None or beside is not None
    lost = Lost() if elsewhere else lost_events(capture, pairs)
    if lost.spans_us:
        _tell_lost(findings, events, lost)
    answered = None if lost.spans_us or sign or elsewhere else answered_share(pairs, events)
    if answered is not None and answered < _FEWEST_ANSWERED:
        findings.warning(
            events.path, "events/x, events/y",
            f"an event at {answered:.0%} of the pixels that change most between frames",
            "events at nearly all of them",
            "Look at events.png of 'evsplat inspect': where events lie beside the edges they are "
            "those of another geometry; where they lie on edges with holes between them, the "
            "pictures are finer than the sensor, and have to be made as coarse "
            "(docs/own-capture.md, two sensors).",
        )  # fmt: skip
    moved = other_way if other_way is not None and other_way.turned else beside
    return EventCheck(findings.items, None if _is_distorted(capture) else moved)


def _is_distorted(capture: TrainingCapture) -> bool:
    return any(capture.is_distorted(frame.camera) for frame in capture.frames)


def _way_there(
    capture: TrainingCapture,
    events: EventStore,
    found: Placement | Disagreement,
    homography: Path | None,
) -> str:
    """What to type to bring events into the pixels of the pictures, and to their polarity."""
    turned = not isinstance(found, Disagreement) or bool(found.turned)
    if turned and _is_distorted(capture):
        # found is a homography of the pinhole camera, and events are stored as its lens bent them
        return (
            "undistort the pictures and bring the events there (docs/event-formats.md, events into "
            "the pixels of the pictures)."
        )
    if turned and homography is None:
        return f"what brings them there is told by: {command('inspect', capture.path)}"
    options: list[str] = []
    if turned:
        options += ["--homography", str(homography), "--size", *map(str, found.size_px)]
    if isinstance(found, Disagreement) and found.inverted:
        options.append("--invert")
    return f"bring them there: {command('convert', events.path, '--in-place', *options)}"


def _tell_lost(findings: Findings, events: EventStore, lost: Lost) -> None:
    """A warning of times with hardly an event where pictures change."""
    spans = [f"{first / 1e6:.3f} to {last / 1e6:.3f} s" for first, last in lost.spans_us]
    where = ", ".join(spans[:3]) + (f" and {len(spans) - 3} more" if len(spans) > 3 else "")
    if lost.elsewhere:
        findings.warning(
            events.path, _WHICH_WAY[1],
            f"hardly an event at the pixels that change, and as many as ever at others, from "
            f"{where}",
            "events wherever the brightness changes",
            "Most likely they lie in other pixels than the pictures': cut out, moved or warped "
            "to another size. events.png of 'evsplat inspect' then shows edges beside those of "
            "the pictures; warp them there (docs/own-capture.md, two sensors). Where it shows "
            "none, clocks are apart by more than a frame (events.clock_offset_us), or the "
            "sensor lost what is no noise.",
        )  # fmt: skip
    else:
        findings.warning(
            events.path, "events/t", f"hardly an event where pictures change from {where}",
            "events wherever the brightness changes",
            "Most likely the sensor lost them, as its rate falls there: record again with a "
            "lower rate of events, or leave out these frames. Otherwise they were left out or "
            "thinned when they were written. Method evsplat learns from frames alone there; "
            "other methods and restore take no event for no change.",
        )  # fmt: skip


def flicker_findings(capture: TrainingCapture) -> list[Finding]:
    """A warning where lamps flicker, of which a camera with long exposures shows nothing."""
    findings = Findings()
    if capture.events is not None and capture.flicker_us:
        findings.warning(
            capture.events.path, "",
            f"all of the picture brighter and darker in turns, {1e6 / capture.flicker_us:.0f} "
            "times a second, as lamps flicker",
            "light that is even",
            "Method evsplat counts events over whole periods, which costs little; other methods, "
            "restore and the estimate of noise take them as they are. Better is light that does "
            "not flicker.",
        )  # fmt: skip
    return findings.items


def lie_elsewhere(findings: Iterable[Finding]) -> bool:
    """Whether `event_findings` say so of events: what clock and thresholds they fit is chance."""
    return any(finding.field in _WHICH_WAY for finding in findings)


def warn_of_events(capture: TrainingCapture, *, thresholds: bool = False) -> bool:
    """Log what is found about events, before a training that learns from them.

    ``thresholds``: whether it takes them by their contrast thresholds, which are told then if they
    do not fit. Gives whether events tell of clock and thresholds, unlike such as lie elsewhere.
    """
    findings = event_findings(capture)
    for finding in findings + flicker_findings(capture):
        logger.warning("%s", finding)
    tell = not lie_elsewhere(findings)
    if thresholds and tell:
        warn_of_contrast(capture, estimate_sensor(capture))
    return tell


def _only_sign(pairs: list[FramePair], events: EventStore) -> str:
    """What all events between frames are, "brighter" or "darker"; empty where they are not."""
    count = brighter = 0
    for pair in pairs:
        start, end = pair.span_us
        low, high = pair.recorded_us
        polarity = events.between(max(start, low), max(start, low, min(end, high))).p
        count, brighter = count + len(polarity), brighter + int((polarity > 0).sum())
    if count < _MANY or 0 < brighter < count:
        return ""
    return "brighter" if brighter else "darker"
