"""A capture in words: what `evsplat inspect` prints of it."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack, nearest_axis, up_axis
from evsplat.calibration import SensorEstimate
from evsplat.capture.capture import Capture
from evsplat.capture.finding import Finding
from evsplat.capture.metadata import Frame
from evsplat.inspection.body_check import body_mask_overlap
from evsplat.inspection.drawing import DETAIL_FRAMES, short_number
from evsplat.inspection.sensor import sensor_lines
from evsplat.spread import evenly_spread
from evsplat.wording import counted

SHOWN_FINDINGS = 12
_EVEN = 0.1
"""Share of the longest by which times differ that are told as one."""


def summary_text(
    capture: Capture, track: BodyTrack | None, estimate: SensorEstimate | None, *, doubted: bool
) -> str:
    """What a capture holds, a line for each kind, without a last line break.

    ``track`` is None where there is no body. ``doubted``: events do not tell what the frames show.
    """
    frames = capture.frames
    cameras = ", ".join(
        f"{name} {capture.cameras[name].width}x{capture.cameras[name].height}"
        for name in sorted({frame.camera for frame in frames})
    )
    starts_us, ends_us = np.transpose([frame.exposure_us for frame in frames])
    exposures_ms, gaps_us = (ends_us - starts_us) / 1000, _gaps_us(frames)
    rate = f", {_rate_text(gaps_us)}" if len(gaps_us) else ""
    lines = [
        f"{capture.name}   {capture.path}",
        f"frames     {len(frames)}: {len(capture.train_frames)} train, {len(capture.test_frames)} "
        f"test; {cameras}, {_stand_text(frames)}{_transfer_text(capture)}",
        f"time       {(ends_us.max() - starts_us.min()) / 1e6:.3f} s{rate}, "
        f"{_exposure_text(exposures_ms)}",
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


def _stand_text(frames: tuple[Frame, ...]) -> str:
    """Whether the cameras stand still."""
    several = len({frame.camera for frame in frames}) > 1
    still = all(frame.world_to_camera is None for frame in frames)
    return f"{'standing' if still else 'moving'} camera{'s' if several else ''}"


def _gaps_us(frames: tuple[Frame, ...]) -> np.ndarray:
    """Times from a frame's middle to that of the next one of its camera."""
    mids_us: dict[str, list[int]] = {}
    for frame in frames:
        mids_us.setdefault(frame.camera, []).append(frame.mid_us)
    return np.concatenate([np.diff(one) for one in mids_us.values()])


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
        + (f"; {counted(len(dense.times_us), 'dense true pose')}" if dense is not None else "")
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
    views = counted(len(novel), "novel view") + (f" ({by_camera})" if novel else "")
    return f"{sharp} sharp, {counted(masks, 'mask')}, {views}"


def findings_text(findings: tuple[Finding, ...]) -> str:
    """How many errors and warnings there are, and the first `SHOWN_FINDINGS` in words."""
    if not findings:
        return "findings   none"
    errors = sum(finding.severity == "error" for finding in findings)
    lines = [f"findings   errors: {errors}, warnings: {len(findings) - errors}"]
    lines += [f"{finding.severity}: {finding}" for finding in findings[:SHOWN_FINDINGS]]
    if len(findings) > SHOWN_FINDINGS:
        lines.append(f"... and {len(findings) - SHOWN_FINDINGS} more; correct these first.")
    return "\n".join(lines)
