"""Parts of importers of your own recordings: camera and events."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.capture.write import CaptureWriter, read_camera
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, open_recording
from evsplat.events.formats.base import SAY_UNIT
from evsplat.importers.base import check_positive, need

GUESSED_FOV_DEG = 60.0
"""Angle of view across the longer side where nothing tells the focal length: a phone held upright
has about 65 degrees, a DAVIS346 with its usual 6 mm lens 61."""


def recorded_camera(
    file: Path | None, focal_px: float | None, size: tuple[int, int]
) -> tuple[dict[str, Any], str, str]:
    """Arguments of `CaptureWriter.add_camera`, where the focal length comes from, and a note.

    The origin is "calibrated" (by ``file``), "given" or "guessed"; it goes to the provenance.
    """
    width, height = size
    if file is not None:
        if focal_px is not None:
            raise ConfigError(f"--focal: {file} holds the camera; give one of the two.")
        return read_camera(need(file, "the camera"), width, height), "calibrated", ""
    if focal_px is not None:
        check_positive(focal=focal_px)
        origin, note = "given", ""
    else:
        focal_px = max(width, height) / 2 / float(np.tan(np.radians(GUESSED_FOV_DEG) / 2))
        origin, note = (
            "guessed",
            f"camera: its focal length is guessed, {focal_px:.0f} px ({GUESSED_FOV_DEG:g} degrees "
            "of view); give --focal PX or --camera FILE",
        )
    K = [[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]
    return {"K": K}, origin, note


def add_recorded_events(
    writer: CaptureWriter,
    path: Path | None,
    size: tuple[int, int],
    *,
    contrast: tuple[float, float] | None,
    clock_offset_us: int,
    repair: bool,
) -> list[str]:
    """Write the events of a recording of any format; gives notes for the user."""
    if path is None:
        return ["events: none; simulate them, or give --events"]
    sensor = open_recording(need(path, "the events"), repair=repair)
    if sensor.width is not None and (sensor.width, sensor.height) != size:
        width, height = size
        raise ConfigError(
            f"{path}: its sensor has {sensor.width}x{sensor.height} pixels, the pictures have "
            f"{width}x{height}, and events have to lie in the pixels of the pictures; warp them "
            "there first (docs/own-capture.md, two sensors). If they do already, say so: evsplat "
            f"convert {path.name} NEW.h5 --width {width} --height {height}"
        )
    recording = open_recording(path, width=size[0], height=size[1], repair=repair)
    if not recording.has_polarity:
        return [f"events: {path.name} has no polarity, so it was left out; simulate them"]
    span: list[int] = []
    writer.set_events(
        _spanning(recording.chunks(), span),
        *size,
        contrast_threshold=contrast,
        simulated=False,
        clock_offset_us=clock_offset_us,
    )
    _check_clock(path, span, writer.exposed_us, clock_offset_us)
    return list(recording.notes)


def _spanning(pieces: Iterable[EventStream], span: list[int]) -> Iterator[EventStream]:
    """The pieces; times of the first and of the last event so far are put into ``span``, us."""
    for piece in pieces:
        if len(piece):
            span[:] = span[0] if span else int(piece.t[0]), int(piece.t[-1])
        yield piece


def _check_clock(path: Path, span: list[int], exposed: tuple[int, int], offset_us: int) -> None:
    """Raise where no event is at the time of a picture: the clocks, or a unit, do not match."""
    if not span:
        raise DataError(
            f"{path}: holds no event, expected those of the recording; give another file, or leave "
            "the events out."
        )
    (first, last), (start, end) = (span[0] + offset_us, span[1] + offset_us), exposed
    if last < start or first >= end:
        raise DataError(
            f"{path}: its events are from {first} to {last} us and the pictures from {start} to "
            f"{end} us, expected events while there are pictures; give --clock-offset-us "
            f"{start - span[0]} if the events begin with the first picture, or the unit of their "
            f"times with {SAY_UNIT}."
        )
