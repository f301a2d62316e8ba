"""Frames and novel views of capture.json."""

from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import Any, Literal

from evsplat.camera import Camera
from evsplat.capture.fields import Fields, is_whole
from evsplat.capture.metadata import Frame, Gain, NovelView
from evsplat.capture.parse_cameras import rigid
from evsplat.untrusted.faults import brief
from evsplat.wording import counted

_LONGEST_EXPOSURE_US = 60_000_000
_MOST_GAIN = 100
_USUAL_GAP_US = (500, 10_000_000)
"""From one frame to the next: no camera of blurry video takes 2,000 a second, and a person in one
frame every ten seconds is another one in each."""
_ROUNDING_US = 2
"""By so much exposures as long as the interval of their frames overlap in whole microseconds."""
_SAME_POSE = 1e-6
"""Largest difference of entries, metres or none, up to which poses count as one."""


def parse_frames(top: Fields, cameras: dict[str, Camera]) -> tuple[Frame, ...]:
    """The frames without errors; faults of the others, and of all together, are noted."""
    entries = top.entries("frames")
    if not entries:
        if "frames" in top.value:
            top.fail("frames", "no frame", "at least one frame", "Add the recorded frames.")
        return ()
    with_split = sum(isinstance(value, dict) and "split" in value for value in entries)
    if with_split not in (0, len(entries)):
        top.fail(
            "frames",
            f"'split' in {with_split} of {len(entries)} frames",
            "a split in every frame or in none",
            "Name 'train' or 'test' for each, or leave all out (index mod 10 in 7, 8, 9 is "
            "test then).",
        )
    frames = []
    for index, value in enumerate(entries):
        frame = _frame(top, index, value, cameras)
        entries[index] = None  # an hour's are 25 MB, whose room the frames can take
        if frame is not None:
            frames.append(frame)
    _check_frames(top, frames)
    return tuple(frames)


def parse_novel_views(
    top: Fields, cameras: dict[str, Camera], frames: tuple[Frame, ...]
) -> tuple[NovelView, ...]:
    """The pictures of other cameras that have no errors."""
    names = {frame.name for frame in frames}
    declared = top.value.get("frames")
    all_valid = isinstance(declared, list) and len(declared) == len(frames)
    views: list[NovelView] = []
    seen: set[tuple[str, str]] = set()
    for index, value in enumerate(top.entries("novel_views", [])):
        keys = ("camera", "frame", "time_us", "image")
        entry = top.inner(f"novel_views[{index}]", value, keys)
        camera, frame = entry.text("camera"), entry.text("frame")
        _check_camera(top, entry, camera, cameras)
        time_us, image = entry.integer("time_us"), entry.path("image")
        if entry.valid and frame not in names:
            if all_valid:
                entry.fail("frame", repr(frame), "the name of a frame", "Correct it.")
            entry.valid = False  # perhaps of a frame whose own fault is noted
        if entry.valid and (camera, frame) in seen:
            entry.fail(
                "frame",
                f"a second view of camera {camera!r} at frame {frame!r}",
                "one view per camera and frame",
                "Remove one.",
            )
        seen.add((camera, frame))
        if entry.valid and image is not None:
            views.append(NovelView(index, camera, frame, time_us, image))
    return tuple(views)


def at_rest(
    cameras: dict[str, Camera], frames: tuple[Frame, ...], views: tuple[NovelView, ...]
) -> tuple[dict[str, Camera], tuple[Frame, ...]]:
    """Cameras and frames; a pose that all frames of the only camera repeat becomes its own.

    Trackers write one for every frame, of a tripod as well; only a camera that stands still has a
    median background, a relief and one drawing of the scene for all frames.
    """
    names = {frame.camera for frame in frames}
    poses = [frame.world_to_camera for frame in frames if frame.world_to_camera is not None]
    if len(names) != 1 or not poses:
        return cameras, frames
    camera = cameras[frames[0].camera]
    pose = poses[0]
    others = [camera.world_to_camera] if len(poses) < len(frames) else []
    if any(view.camera in names for view in views):
        others.append(camera.world_to_camera)
    if any(float((other - pose).abs().max()) > _SAME_POSE for other in (*poses, *others)):
        return cameras, frames
    standing = Camera(camera.width, camera.height, camera.K, pose)
    still = tuple(replace(frame, world_to_camera=None) for frame in frames)
    return cameras | {frames[0].camera: standing}, still


def _frame(top: Fields, index: int, value: Any, cameras: dict[str, Camera]) -> Frame | None:
    keys = ("name", "camera", "image", "exposure_us", "split", "sharp", "mask", "gain")
    entry = top.inner(f"frames[{index}]", value, (*keys, "world_to_camera"))
    name, camera = entry.name("name"), entry.text("camera")
    _check_camera(top, entry, camera, cameras)
    image = entry.path("image")
    exposure = _exposure(entry)
    split = entry.text("split", default_split(index))
    if entry.valid and split not in ("train", "test"):
        entry.fail("split", repr(split), "'train' or 'test'", "Correct it.")
    sharp = entry.path("sharp", required=False)
    mask = entry.path("mask", required=False)
    pose = rigid(entry, "world_to_camera", None)
    gain = _gain(entry)
    if not entry.valid or image is None or exposure is None:
        return None
    kind: Literal["train", "test"] = "train" if split == "train" else "test"
    return Frame(name, index, camera, str(image), exposure, kind, sharp, mask, pose, gain)


def _check_camera(top: Fields, entry: Fields, camera: str, cameras: dict[str, Camera]) -> None:
    """A finding where nothing declares the camera; a fault of its own is noted once, not here."""
    if not entry.valid or camera in cameras:
        return
    declared = top.value.get("cameras")
    if not isinstance(declared, dict) or camera not in declared:
        expected = f"one of the cameras {sorted(cameras)}"
        entry.fail("camera", repr(camera), expected, "Correct the name or add the camera.")
    entry.valid = False


def _exposure(entry: Fields) -> tuple[int, int] | None:
    pair = entry.numbers("exposure_us", (2,))
    if pair is None:
        return None
    if not all(is_whole(value) for value in pair.tolist()):
        entry.fail("exposure_us", str(pair.tolist()), "whole microseconds", "Round them.")
        return None
    start, end = int(pair[0]), int(pair[1])
    if end <= start:
        kind = "an empty exposure" if end == start else "a negative exposure"
        entry.fail(
            "exposure_us",
            f"{kind} [{start}, {end}]",
            "[start, end] with start < end in microseconds",
            "Give the times when the shutter opened and closed.",
        )
        return None
    if end - start > _LONGEST_EXPOSURE_US:
        entry.fail(
            "exposure_us",
            f"{end - start} us",
            f"at most {_LONGEST_EXPOSURE_US}, a minute",
            "Give times in microseconds.",
        )
        return None
    return start, end


def _gain(entry: Fields) -> Gain | None:
    if entry.get("gain", None) is None:
        return None
    shape = (3,) if isinstance(entry.get("gain"), list) else ()
    gain = entry.numbers("gain", shape)
    if gain is None:
        return None
    if not ((gain >= 1 / _MOST_GAIN) & (gain <= _MOST_GAIN)).all():
        entry.fail(
            "gain",
            brief(gain.tolist()),
            f"factors of light from 1/{_MOST_GAIN} to {_MOST_GAIN}",
            "Give how bright the picture shows the scene against the brightest ones, or leave it "
            "out.",
        )
        return None
    return tuple(gain.reshape(-1).tolist())


def _check_frames(top: Fields, frames: list[Frame]) -> None:
    """Findings that need all frames together: names, order, overlap, splits."""
    first_of: dict[str, int] = {}
    last_of: dict[str, Frame] = {}
    overlaps = []
    for frame in frames:
        where = f"frames[{frame.index}]"
        if frame.name in first_of:
            top.findings.error(
                top.file,
                f"{where}.name",
                f"{frame.name!r}, already the name of frames[{first_of[frame.name]}]",
                "a name of its own for each frame",
                "Rename one of the two.",
            )
        first_of.setdefault(frame.name, frame.index)
        before = last_of.get(frame.camera)
        last_of[frame.camera] = frame
        if before is None:
            continue
        if frame.exposure_us[0] <= before.exposure_us[0]:
            top.findings.error(
                top.file,
                f"{where}.exposure_us",
                f"a start of {frame.exposure_us[0]}, not after {before.exposure_us[0]} of "
                f"frame {before.name!r}",
                "frames of a camera in order of time",
                "Sort the frames, or correct the exposure.",
            )
        elif frame.exposure_us[0] < before.exposure_us[1] - _ROUNDING_US:
            overlaps.append(frame)
    if overlaps:
        top.findings.warning(
            top.file,
            f"frames[{overlaps[0].index}].exposure_us",
            f"{counted(len(overlaps), 'exposure')} begun before the one before ended "
            f"(first: frame {overlaps[0].name!r})",
            "exposures that do not overlap",
            "Check the exposure time; a sharp moment is then seen by two frames.",
        )
    _check_unit(frames, top)
    if frames and not any(frame.split == "train" for frame in frames):
        top.findings.error(
            top.file,
            "frames",
            f"no train frame among {len(frames)}",
            "at least one frame with split 'train'",
            "Change the split of some frames.",
        )
    if frames and not any(frame.split == "test" for frame in frames):
        top.findings.warning(
            top.file,
            "frames",
            f"no test frame among {len(frames)}",
            "at least one frame with split 'test'",
            "Training is not measured without one: give every frame a split, 'test' or 'train' "
            "(where none has one, 7, 8 and 9 of every ten are test frames, the first being 0).",
        )


def default_split(index: int) -> str:
    """The split where a capture gives none: three frames of ten are test."""
    return "test" if index % 10 in (7, 8, 9) else "train"


def _check_unit(frames: list[Frame], top: Fields) -> None:
    """A warning where exposures follow each other as they do if times are in another unit."""
    starts: dict[str, list[int]] = {camera: [] for camera in {frame.camera for frame in frames}}
    for frame in frames:
        starts[frame.camera].append(frame.exposure_us[0])
    gaps = [b - a for each in starts.values() for a, b in pairwise(each)]
    gap_us = median(gaps) if gaps else _USUAL_GAP_US[0]
    shortest, longest = _USUAL_GAP_US
    if shortest <= gap_us <= longest:
        return
    unit = "milliseconds" if gap_us < shortest else "nanoseconds"
    top.findings.warning(
        top.file,
        "frames[0].exposure_us",
        f"exposures that begin every {gap_us:g} us",
        f"{shortest} to {longest} us from one frame to the next",
        f"Give times in microseconds; these look like {unit}.",
    )
