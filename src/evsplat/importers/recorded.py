"""Parts of importers of your own recordings: camera and events."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.capture.write import CaptureWriter, read_camera
from evsplat.commands import command
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, open_recording
from evsplat.events.formats.base import SAY_UNIT
from evsplat.importers.base import check_positive, need

GUESSED_FOV_DEG = 60.0
"""Angle of view across the longer side where nothing tells the focal length: a phone held upright
has about 65 degrees, a DAVIS346 with its usual 6 mm lens 61."""
_COVERED = 0.9
"""Share of the pictures' time below which events that cover no more are remarked."""
_MANY = 100
"""Events of which some are of either polarity."""


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
        of_events = {"contrast": contrast, "clock-offset-us": clock_offset_us, "repair": repair}
        for name, value in of_events.items():
            if value:
                raise ConfigError(f"--{name}: there are no events; give --events, or leave it out.")
        return ["events: none; simulate them, or give --events"]
    sensor = open_recording(need(path, "the events"), repair=repair)
    if sensor.width is not None and (sensor.width, sensor.height) != size:
        width, height = map(str, size)
        said = command("convert", path, "NEW.h5", "--width", width, "--height", height)
        raise ConfigError(
            f"{path}: its sensor has {sensor.width}x{sensor.height} pixels, the pictures have "
            f"{width}x{height}, and events have to lie in the pixels of the pictures; warp them "
            f"there first (docs/own-capture.md, two sensors). If they do already, say so: {said}"
        )
    recording = open_recording(path, width=size[0], height=size[1], repair=repair)
    if not recording.has_polarity:
        return [f"events: {path.name} has no polarity, so it was left out; simulate them"]
    passed = _Passed()
    writer.set_events(
        passed.watching(recording.chunks()),
        *size,
        contrast_threshold=contrast,
        simulated=False,
        clock_offset_us=clock_offset_us,
    )
    return [*recording.notes, *passed.notes(path, writer.exposed_us, clock_offset_us)]


@dataclass
class _Passed:
    """Events that were written: from when to when, how many, and how many of them brighter."""

    first_us: int = 0
    last_us: int = 0
    count: int = 0
    brighter: int = 0

    def watching(self, pieces: Iterable[EventStream]) -> Iterator[EventStream]:
        """The pieces, one after the other."""
        for piece in pieces:
            if len(piece):
                self.first_us = self.first_us if self.count else int(piece.t[0])
                self.last_us = int(piece.t[-1])
                self.count += len(piece)
                self.brighter += int((piece.p > 0).sum())
            yield piece

    def notes(self, path: Path, exposed_us: tuple[int, int], offset_us: int) -> list[str]:
        """What is odd about them; raises where none is at the time of a picture."""
        if not self.count:
            raise DataError(
                f"{path}: holds no event, expected those of the recording; give another file, or "
                "leave the events out."
            )
        first, last, (start, end) = self.first_us + offset_us, self.last_us + offset_us, exposed_us
        times = f"from {first} to {last} us and the pictures from {start} to {end} us"
        if last < start or first >= end:
            raise DataError(
                f"{path}: its events are {times}, expected events while there are pictures; give "
                f"--clock-offset-us {start - self.first_us} if the events begin with the first "
                f"picture, or the unit of their times with {SAY_UNIT}."
            )
        notes = []
        covered = (min(last, end) - max(first, start)) / (end - start)
        if covered < _COVERED:
            notes.append(
                f"events: {path.name} covers {covered:.1%} of the pictures' time (it is {times}); "
                f"check clock, rate of the pictures and unit of the times ({SAY_UNIT})"
            )
        if self.count >= _MANY and self.brighter in (0, self.count):
            sign = "brighter" if self.brighter else "darker"
            notes.append(
                f"events: all {self.count:,} of {path.name} are {sign}, as no scene makes them; "
                "check its polarity"
            )
        return notes
