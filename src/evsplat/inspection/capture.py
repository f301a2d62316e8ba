"""`evsplat inspect`: check a capture, sum it up in words and draw it."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image
from tqdm import tqdm

from evsplat.body import BodyTrack, track_silhouette
from evsplat.capture import estimate_sensor, load_body_track, shared_pairs
from evsplat.capture.capture import Capture
from evsplat.capture.finding import Finding
from evsplat.capture.metadata import Frame
from evsplat.capture.policy import Policy
from evsplat.capture.sensor_estimate import contrast_findings
from evsplat.capture.validate import check_capture
from evsplat.errors import EvsplatError
from evsplat.events.homography import write_homography
from evsplat.files import remove_file, try_target
from evsplat.inspection.belonging import judge_body
from evsplat.inspection.body_check import FIT_SHEET, body_findings, check_body, fit_sheet
from evsplat.inspection.drawing import (
    DETAIL_FRAMES,
    DETAIL_PX,
    EVENT_WINDOW_US,
    Tile,
    draw_outline,
    event_tile,
    fit,
    save_drawings,
    sheet,
    to_picture,
)
from evsplat.inspection.event_check import (
    check_events,
    flicker_findings,
    lie_elsewhere,
    warn_of_events,
)
from evsplat.inspection.folder import note_inspected
from evsplat.inspection.picture_check import picture_findings, warn_of_pictures
from evsplat.inspection.plots import draw_timeline
from evsplat.inspection.sensor import clock_findings
from evsplat.inspection.summary import findings_text, summary_text
from evsplat.spread import evenly_spread
from evsplat.wording import counted

logger = logging.getLogger(__name__)

HOMOGRAPHY = "events_to_pictures.txt"
"""File beside the drawings: by what to move events that lie beside the pixels of the pictures."""
CONTACT_FRAMES = 64
_OUTLINE, _OUTLINE_ENDS = (60, 255, 120), (255, 225, 80)


@dataclass(frozen=True)
class InspectReport:
    """Findings, summary and pictures of an inspection."""

    path: Path
    findings: tuple[Finding, ...]
    summary: str
    """Text of several lines, to be printed."""
    pictures: tuple[Path, ...]

    @property
    def usable(self) -> bool:
        """True without errors (warnings are allowed)."""
        return not any(finding.severity == "error" for finding in self.findings)


def inspect_capture(path: Path | str, out_dir: Path | str) -> InspectReport:
    """Validate the capture fully and, where it has no errors, draw it into ``out_dir``.

    Writes contact_sheet.png, events.png, body.png, body_fit.png and timeline.png, as far as there
    is something to draw, and inspected.json, what they show. Where events lie beside the pixels of
    the pictures, what brings them there is written to events_to_pictures.txt
    (`evsplat.events.moved`); else an earlier one is removed.
    """
    path, out_dir = Path(path), Path(out_dir)
    try_target(out_dir)
    homography = out_dir / HOMOGRAPHY
    remove_file(homography)
    metadata, found = check_capture(path, deep=True)
    report = InspectReport(path, tuple(found), "", ())
    if metadata is None or not report.usable:
        return replace(report, summary=f"{path}\n{findings_text(report.findings)}")
    capture = Capture(metadata)
    seen = capture.for_training(Policy(use="everything"))
    with shared_pairs(seen):
        events = check_events(seen, homography)
        of_events = events.findings
        estimate = None if lie_elsewhere(of_events) else estimate_sensor(seen)
    findings = (
        *found,
        *picture_findings(seen),
        *of_events,
        *flicker_findings(seen),
        *clock_findings(capture, estimate),
        *contrast_findings(capture, estimate),
    )
    track = load_body_track(capture) if capture.has_body else None
    fitting = None if track is None else judge_body(seen, track)
    drawings = {"contact_sheet": _contact_sheet(capture)}
    if track is not None:
        drawings["body"] = _body_sheet(capture, track)
    if fitting is not None:
        findings = (*findings, *body_findings(seen, fitting))
        drawings[FIT_SHEET] = fit_sheet(seen, fitting)
    if capture.events is not None and len(capture.events):
        drawings["events"] = _events_sheet(capture)
    drawings["timeline"] = draw_timeline(capture)
    note_inspected(path, out_dir)
    if (beside := events.mendable) is not None:
        write_homography(homography, beside.homography, beside.size_px)
    pictures = save_drawings(drawings, out_dir)
    summary = summary_text(capture, track, estimate, doubted=bool(of_events))
    if fitting is not None:
        summary += f"\nbelongs    {fitting.sentence}"
    summary += f"\n{findings_text(findings)}\npictures   {out_dir}: "
    summary += ", ".join(picture.name for picture in pictures)
    return replace(report, findings=findings, summary=summary, pictures=pictures)


def warn_of_capture(path: Path, body_models: Path | None = None) -> None:
    """Log what is odd about a new capture's pictures, events and body, as training sees them.

    ``body_models`` is as of `evsplat.capture.body_track.load_body`.
    """
    metadata, found = check_capture(path, deep=False)
    if metadata is None:
        return
    for finding in found:
        # Notes of an import speak of events and body.
        if finding.field.startswith(("frames", "cameras")):
            logger.warning("%s", finding)
    capture = Capture(metadata)
    seen = capture.for_training(Policy())
    with shared_pairs(seen):
        warn_of_pictures(seen)
        estimate = estimate_sensor(seen) if warn_of_events(seen) else None
    for finding in clock_findings(capture, estimate):
        logger.warning("%s", finding)
    try:
        if seen.has_body:
            check_body(seen, refuse=False, body_models=body_models)
    except EvsplatError as error:  # such as an SMPL file that training will have to find
        logger.info("The body is not compared with the recording: %s", error)


def _label(frame: Frame) -> str:
    return f"{frame.name}   {frame.mid_us / 1e6:.3f} s"


def _drawn(frames: Sequence[Frame], what: str) -> Iterable[Frame]:
    """The frames, with a bar on a terminal: pictures of 8 megapixels take a second each."""
    return tqdm(frames, what, unit="frame", leave=False, disable=None)


def _contact_sheet(capture: Capture) -> Image.Image:
    chosen = evenly_spread(capture.frames, CONTACT_FRAMES)
    tiles = []
    for frame in _drawn(chosen, "frames"):
        camera = capture.camera(frame)
        picture = to_picture(
            capture.shown(capture.image(frame)), fit(camera.width, camera.height, 170)
        )
        tiles.append(Tile(picture, _label(frame), frame.split))
    some = "" if len(chosen) == len(capture.frames) else f"{len(chosen)} of "
    subtitle = f"{some}{counted(len(capture.frames), 'frame')} as the camera saw them"
    return sheet(f"{capture.name}: frames", subtitle, tiles, columns=8)


def _events_sheet(capture: Capture) -> Image.Image:
    """Events in the middle of the exposure over the greyed picture."""
    assert capture.events is not None
    tiles = [
        event_tile(
            capture.events,
            capture.shown(capture.image(frame)),
            frame.mid_us,
            _label(frame),
            frame.split,
        )
        for frame in _drawn(evenly_spread(capture.frames, DETAIL_FRAMES), "events")
    ]
    subtitle = f"{EVENT_WINDOW_US / 1000:g} ms about mid-exposure; red: brighter, blue: darker"
    return sheet(f"{capture.name}: events", subtitle, tiles, columns=4)


def _body_sheet(capture: Capture, track: BodyTrack) -> Image.Image:
    """Outline of the posed body at mid-exposure, thin lines where it is at the exposure's ends."""
    tiles = []
    for frame in _drawn(evenly_spread(capture.frames, DETAIL_FRAMES), "body"):
        camera = capture.camera(frame)
        size = fit(camera.width, camera.height, DETAIL_PX)
        picture = to_picture(capture.shown(capture.image(frame)), size)
        large = camera.resized(*size)
        for time_us in frame.exposure_us:
            body = track_silhouette(track, time_us, large).numpy()
            draw_outline(picture, body, _OUTLINE_ENDS, halo=False)
        draw_outline(picture, track_silhouette(track, frame.mid_us, large).numpy(), _OUTLINE)
        tiles.append(Tile(picture, _label(frame), frame.split))
    subtitle = "posed body at mid-exposure (green) and at the exposure's ends (yellow)"
    return sheet(f"{capture.name}: body", subtitle, tiles, columns=4)
