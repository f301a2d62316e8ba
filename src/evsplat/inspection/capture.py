"""`evsplat inspect`: check a capture, sum it up in words and draw it."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from evsplat.body import BodyTrack, nearest_axis, track_silhouette, up_axis
from evsplat.calibration import SensorEstimate
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
    DETAIL_PX,
    EVENT_WINDOW_US,
    Tile,
    draw_outline,
    event_tile,
    fit,
    save_drawings,
    sheet,
    short_number,
    to_picture,
)
from evsplat.inspection.event_check import (
    check_events,
    flicker_findings,
    lie_elsewhere,
    warn_of_events,
)
from evsplat.inspection.picture_check import picture_findings, warn_of_pictures
from evsplat.inspection.plots import draw_timeline
from evsplat.inspection.sensor import clock_findings, sensor_lines
from evsplat.spread import evenly_spread
from evsplat.wording import counted

logger = logging.getLogger(__name__)

HOMOGRAPHY = "events_to_pictures.txt"
"""File beside the drawings: by what to move events that lie beside the pixels of the pictures."""
CONTACT_FRAMES, DETAIL_FRAMES = 64, 8
SHOWN_FINDINGS = 12
_EVEN = 0.1
"""Share of the longest by which times differ that are told as one."""
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
    is something to draw. Where events lie beside the pixels of the pictures, what brings them there
    is written to events_to_pictures.txt (`evsplat.events.moved`); else an earlier one is removed.
    """
    path, out_dir = Path(path), Path(out_dir)
    try_target(out_dir)
    homography = out_dir / HOMOGRAPHY
    remove_file(homography)
    metadata, found = check_capture(path, deep=True)
    report = InspectReport(path, tuple(found), "", ())
    if metadata is None or not report.usable:
        return replace(report, summary=f"{path}\n{_findings_text(report.findings)}")
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
    if (beside := events.mendable) is not None:
        write_homography(homography, beside.homography, beside.size_px)
    pictures = save_drawings(drawings, out_dir)
    summary = _summary(capture, track, estimate, doubted=bool(of_events))
    if fitting is not None:
        summary += f"\nbelongs    {fitting.sentence}"
    summary += f"\n{_findings_text(findings)}\npictures   {out_dir}: "
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
        if finding.field.startswith("frames"):  # notes of an import speak of events and body
            logger.warning("%s", finding)
    seen = Capture(metadata).for_training(Policy())
    warn_of_pictures(seen)
    warn_of_events(seen)
    try:
        if seen.has_body:
            check_body(seen, refuse=False, body_models=body_models)
    except EvsplatError as error:  # such as an SMPL file that training will have to find
        logger.info("The body is not compared with the recording: %s", error)


def body_mask_overlap(capture: Capture, track: BodyTrack, frames: Sequence[Frame]) -> list[float]:
    """Intersection over union of posed body and person mask, for the frames that have a mask.

    Frames with neither in the picture, as after somebody has left, tell nothing and are passed
    over.
    """
    overlaps = []
    for frame in frames:
        mask = capture.mask(frame)
        if mask is not None:
            body = track_silhouette(track, frame.mid_us, capture.camera(frame)).numpy()
            person = mask.numpy() > 0.5
            if (either := int((body | person).sum())) > 0:
                overlaps.append(float((body & person).sum() / either))
    return overlaps


def _summary(
    capture: Capture, track: BodyTrack | None, estimate: SensorEstimate | None, *, doubted: bool
) -> str:
    frames = capture.frames
    cameras = ", ".join(
        f"{name} {capture.cameras[name].width}x{capture.cameras[name].height}"
        for name in sorted({frame.camera for frame in frames})
    )
    start, end = frames[0].exposure_us[0], frames[-1].exposure_us[1]
    exposures_ms = np.array([b - a for a, b in (frame.exposure_us for frame in frames)]) / 1000
    rate = f", {_rate_text(np.diff([frame.mid_us for frame in frames]))}" if frames[1:] else ""
    lines = [
        f"{capture.name}   {capture.path}",
        f"frames     {len(frames)}: {len(capture.train_frames)} train, {len(capture.test_frames)} "
        f"test; {cameras}, {'standing' if capture.is_static_camera else 'moving'} camera"
        f"{_transfer_text(capture)}",
        f"time       {(end - start) / 1e6:.3f} s{rate}, {_exposure_text(exposures_ms)}",
        *_gain_lines(frames),
        f"events     {_events_text(capture)}",
        *_sensor_lines(capture, estimate, doubted),
        f"body       {_body_text(capture, track)}",
        *_up_lines(track),
        f"truth      {_truth_text(capture)}",
    ]
    shown = evenly_spread(frames, DETAIL_FRAMES)
    overlaps = [] if track is None else body_mask_overlap(capture, track, shown)
    if overlaps:
        lines.append(
            f"fit        posed body over masks: IoU {np.mean(overlaps):.2f} "
            f"(least {min(overlaps):.2f}; clothes and hair are not part of the body)"
        )
    for verb in ("restored", "masks"):
        made = capture.provenance.get(verb)
        if isinstance(made, dict) and "with" in made:
            lines.append(f"{verb:10} with {made['with']}")
    if capture.poses_found is not None:
        lines.append(f"poses      {capture.poses_found}")
    if "text" in capture.provenance:
        lines.append(f"made       {capture.provenance['text']}")
    return "\n".join(lines)


def _gain_lines(frames: tuple[Frame, ...]) -> list[str]:
    """From what to what gains of the frames go, of all colours; no line where none is said."""
    gains = [gain for frame in frames for gain in frame.gain or ()]
    if not gains:
        return []
    return [
        f"gain       {min(gains):.2f} to {max(gains):.2f} of the brightest pictures' light, evened "
        "out on reading"
    ]


def _rate_text(gaps_us: np.ndarray) -> str:
    """Frames a second; where they are not evenly spaced, how far apart they are as well."""
    usual = float(np.median(gaps_us))
    text = f"{1e6 / usual:.4g} frames/s" if usual > 0 else "frames of one time"
    return text + _range_text(gaps_us / 1000, " apart")


def _exposure_text(exposures_ms: np.ndarray) -> str:
    """The exposure of all frames; the range of theirs where a camera changed it."""
    return f"exposure {np.median(exposures_ms):.4g} ms" + _range_text(exposures_ms)


def _range_text(times_ms: np.ndarray, words: str = "") -> str:
    """From the shortest to the longest, of which the median was told; "" where they are alike."""
    shortest, longest = times_ms.min(), times_ms.max()
    if longest - shortest <= _EVEN * longest:
        return ""
    return f" (median; {shortest:.4g} to {longest:.4g} ms{words})"


def _transfer_text(capture: Capture) -> str:
    """The curve from values to light, where capture.json says it."""
    stated = {capture.metadata.transfers.get(frame.camera) for frame in capture.frames} - {None}
    return f"; values: {', '.join(sorted(str(one) for one in stated))}" if stated else ""


def _sensor_lines(capture: Capture, estimate: SensorEstimate | None, doubted: bool) -> list[str]:
    events = capture.events
    if events is None:
        return []
    if not len(events):
        return ["clock      not estimated: there is no event"]
    if len(capture.frames) == 1:
        return ["clock      not estimated: one frame shows no change"]
    if estimate is None and doubted:
        return ["clock      not estimated: events do not tell what the frames show (findings)"]
    return sensor_lines(estimate, capture.clock_offset_us, has_polarity=events.has_polarity)


def _events_text(capture: Capture) -> str:
    events = capture.events
    if events is None:
        return "none"
    first, last = events.time_range_us
    seconds = max(last - first, 1) / 1e6
    thresholds = capture.contrast_threshold
    return (
        f"{len(events):,} over {seconds:.3f} s ({short_number(len(events) / seconds)}/s), "
        f"{'simulated' if capture.events_simulated else 'recorded'}, "
        + (f"C+ {thresholds[0]:g}, C- {thresholds[1]:g}" if thresholds else "C unknown")
        + (f", clock offset {capture.clock_offset_us} us" if capture.clock_offset_us else "")
    )


def _body_text(capture: Capture, track: BodyTrack | None) -> str:
    if track is None:
        return "none"
    body, times, dense = track.body, capture.body_file.times_us, capture.dense_body_file
    return (
        f"{capture.body_file.model}: {len(body.parents)} joints, {len(body.rest_vertices):,} "
        f"vertices; {counted(len(times), 'key pose')} from {times[0] / 1e6:.3f} to "
        f"{times[-1] / 1e6:.3f} s"
        + ("" if track.errors is None else f", {track.errors.source}")
        + (f"; {len(dense.times_us)} dense true poses" if dense is not None else "")
    )


def _up_lines(track: BodyTrack | None) -> list[str]:
    """Which way is up, where capture.json says so, or the person's body and the cameras differ."""
    if track is None:
        return []
    up = _axis_text(up_axis(track))
    if track.up is not None:
        return [f"up         {up}, as capture.json says"]
    pictures = up if track.camera_up is None else _axis_text(nearest_axis(track.camera_up))
    if up == pictures:
        return []
    return [
        f"up         {up}, where the person's head mostly is, and not {pictures}, which is up in "
        'the pictures; somebody who lies needs "up" in capture.json (docs/capture-format.md)'
    ]


def _axis_text(axis: Float[Tensor, "3"]) -> str:
    """Such as ``-y``."""
    index = int(axis.abs().argmax())
    return f"{'-' if axis[index] < 0 else '+'}{'xyz'[index]}"


def _truth_text(capture: Capture) -> str:
    sharp = sum(frame.sharp is not None for frame in capture.frames)
    masks = sum(frame.mask is not None for frame in capture.frames)
    novel = [view.camera for view in capture.novel_views]
    by_camera = ", ".join(f"{name} {novel.count(name)}" for name in sorted(set(novel)))
    views = f"{len(novel)} novel views" + (f" ({by_camera})" if novel else "")
    return f"{sharp} sharp, {masks} masks, {views}"


def _findings_text(findings: tuple[Finding, ...]) -> str:
    if not findings:
        return "findings   none"
    errors = sum(finding.severity == "error" for finding in findings)
    lines = [f"findings   errors: {errors}, warnings: {len(findings) - errors}"]
    lines += [f"{finding.severity}: {finding}" for finding in findings[:SHOWN_FINDINGS]]
    if len(findings) > SHOWN_FINDINGS:
        lines.append(f"... and {len(findings) - SHOWN_FINDINGS} more; correct these first.")
    return "\n".join(lines)


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
    subtitle = f"{some}{len(capture.frames)} frames as the camera saw them"
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
