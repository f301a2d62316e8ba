"""Parts of importers of your own recordings: camera and events."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from evsplat.calibration.offset import BlockChanges
from evsplat.capture.camera_file import read_camera
from evsplat.capture.write import CaptureWriter
from evsplat.commands import command
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, open_recording
from evsplat.events.formats.base import SAY_UNIT
from evsplat.events.homography import Mover
from evsplat.footage import Footage, TimedPicture
from evsplat.importers.base import need, shrunk, shrunk_view
from evsplat.importers.clock_offset import found_offset
from evsplat.importers.place_finder import PlaceFinder
from evsplat.pictures.files import to_unit_range

GUESSED_FOV_DEG = 60.0
"""Angle of view across the longer side where nothing tells the focal length: a phone held upright
has about 65 degrees, a DAVIS346 with its usual 6 mm lens 61."""
_COVERED = 0.9
"""Share of the pictures' time below which events that cover no more are remarked."""
_MANY_PIXELS = 1_500_000
"""Pixels of a picture above which training takes minutes before its first step."""
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


def shrunk_camera(
    camera: dict[str, Any], size: tuple[int, int], factor: int
) -> tuple[dict[str, Any], tuple[int, int]]:
    """`recorded_camera` of pictures of ``size`` made smaller by ``factor``, and their size."""
    K, small = shrunk_view(camera["K"], size, factor)
    return {**camera, "K": K}, small


def large_pictures(size: tuple[int, int]) -> list[str]:
    """A note where pictures have so many pixels that training is slow."""
    width, height = size
    factor = math.ceil(math.sqrt(width * height / _MANY_PIXELS))
    if factor == 1:
        return []
    return [
        f"pictures: {width}x{height} pixels, with which training is slow; --shrink {factor} makes "
        f"them {width // factor}x{height // factor}"
    ]


def pictures_of(footage: Footage, wanted: Sequence[int]) -> Iterator[tuple[int, TimedPicture]]:
    """Number and picture of those that are ``wanted``, ascending; none after them is decoded."""
    pictures = enumerate(footage)
    for number in tqdm(wanted, "pictures", leave=False):
        found = next((one for one in pictures if one[0] == number), None)
        if found is not None:
            yield found


def add_recorded_frame(
    writer: CaptureWriter,
    picture: TimedPicture,
    exposure_us: tuple[int, int],
    clock_offset: int | BlockChanges,
    *,
    shrink: int = 1,
    mask: Float[np.ndarray, "H W"] | None = None,
    world_to_camera: Float[np.ndarray, "4 4"] | None = None,
) -> None:
    """Write a frame of camera "main"; gather its changes where the clock's offset is to be found.

    Picture and mask are made smaller by ``shrink``.
    """
    pixels = shrunk(picture.pixels, shrink)
    writer.add_frame(
        picture.name,
        "main",
        pixels,
        exposure_us,
        mask=None if mask is None else shrunk(mask, shrink),
        world_to_camera=world_to_camera,
    )
    if isinstance(clock_offset, BlockChanges):
        clock_offset.add(to_unit_range(pixels), exposure_us)


def add_recorded_events(
    writer: CaptureWriter,
    path: Path | None,
    size: tuple[int, int],
    clock_offset: int | BlockChanges,
    *,
    contrast: tuple[float, float] | None,
    repair: bool,
    mover: Mover | PlaceFinder | None = None,
    exposed_only: bool = False,
    shrink: int = 1,
) -> list[str]:
    """Write the events of a recording of any format; gives notes for the user.

    ``clock_offset`` is in us, or the changes of the frames by which it is found. ``exposed_only``
    leaves out events before the first exposure and after the last. ``size`` is that of the pictures
    as recorded, in whose pixels the events are, or are brought by ``mover``, which may have to be
    found; both are made smaller by ``shrink``.
    """
    if path is None:
        of_events = {
            "contrast": contrast,
            "clock-offset-us": clock_offset,
            "repair": repair,
            "homography": mover,
        }
        for name, value in of_events.items():
            if value:
                raise ConfigError(f"--{name}: there are no events; give --events, or leave it out.")
        return ["events: none; simulate them, or give --events"]
    sensor = open_recording(need(path, "the events"), repair=repair)
    if not sensor.has_polarity:  # asked first: nobody needs to warp what is left out
        return [f"events: {path.name} has no polarity, so it was left out; simulate them"]
    if mover is None and sensor.width is not None and (sensor.width, sensor.height) != size:
        width, height = map(str, size)
        said = command("convert", path, "NEW.h5", "--width", width, "--height", height)
        raise ConfigError(
            f"{path}: its sensor has {sensor.width}x{sensor.height} pixels, the pictures have "
            f"{width}x{height}, and events have to lie in the pixels of the pictures; move them "
            "there by --homography FILE, or auto to have it found (docs/own-capture.md, two "
            f"sensors). If they do already, say so: {said}"
        )
    recording, told = sensor, list[str]()
    if isinstance(mover, PlaceFinder):
        mover, told = mover.mover(sensor, clock_offset, writer)
    if mover is None:
        recording = open_recording(path, width=size[0], height=size[1], repair=repair)

    def pieces() -> Iterable[EventStream]:
        return recording.chunks() if mover is None else mover.moved(recording.chunks(), path)

    notes = write_recorded_events(
        writer,
        pieces,
        path,
        size,
        clock_offset,
        contrast=contrast,
        exposed_only=exposed_only,
        shrink=shrink,
        one_file=False,
    )
    # Repairs are known once the events have been read.
    return [*told, *(recording.notes if mover is None else mover.notes(recording)), *notes]


def write_recorded_events(
    writer: CaptureWriter,
    pieces: Callable[[], Iterable[EventStream]],
    path: Path,
    size: tuple[int, int],
    clock_offset: int | BlockChanges,
    *,
    contrast: tuple[float, float] | None,
    exposed_only: bool,
    shrink: int,
    one_file: bool,
) -> list[str]:
    """Write the events of ``path``, which ``pieces`` gives anew each time; gives notes.

    The rest is as of `add_recorded_events`. ``one_file``: the pictures are in it as well, on
    one clock, and the format says the unit of its times.
    """
    passed, notes = _Passed(), []
    if isinstance(clock_offset, BlockChanges):
        clock_offset, note = found_offset(clock_offset, pieces, path, size, one_file=one_file)
        notes.append(note)
    start, end = (time - clock_offset for time in writer.exposed_us)
    shrunken = passed.watching(_shrunk_events(pieces(), size, shrink))
    writer.set_events(
        (piece.between(start, end) for piece in shrunken) if exposed_only else shrunken,
        size[0] // shrink,
        size[1] // shrink,
        contrast_threshold=contrast and _shrunk_contrast(contrast, shrink),
        simulated=False,
        clock_offset_us=clock_offset,
    )
    return notes + passed.notes(path, writer.exposed_us, clock_offset, one_file=one_file)


def _shrunk_events(
    pieces: Iterable[EventStream], size: tuple[int, int], factor: int
) -> Iterator[EventStream]:
    """The events in the squares of ``factor`` pixels that pictures of ``size`` are made of."""
    for piece in pieces:
        if factor > 1:
            x, y = piece.x // factor, piece.y // factor
            inside = (x < size[0] // factor) & (y < size[1] // factor)
            piece = EventStream(piece.t, x, y, piece.p).take(inside)
        yield piece


def _shrunk_contrast(contrast: tuple[float, float], factor: int) -> tuple[float, float]:
    """Thresholds of squares of pixels: one pixel's event is a share of the mean's change."""
    return contrast[0] / factor**2, contrast[1] / factor**2


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

    def notes(
        self, path: Path, exposed_us: tuple[int, int], offset_us: int, *, one_file: bool
    ) -> list[str]:
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
                "--clock-offset-us auto, which finds the offset"
                + ("." if one_file else f", or the unit of their times with {SAY_UNIT}.")
            )
        notes, unit = [], f"the unit of the times ({SAY_UNIT})"
        covered = (min(last, end) - max(first, start)) / (end - start)
        if covered < _COVERED:
            notes.append(
                f"events: {path.name} covers {covered:.1%} of the pictures' time (it is {times}); "
                "check the clock (--clock-offset-us auto finds its offset)"
                + ("" if one_file else f", the rate of the pictures and {unit}")
            )
        if self.count >= _MANY and self.brighter in (0, self.count):
            sign = "brighter" if self.brighter else "darker"
            notes.append(
                f"events: all {self.count:,} of {path.name} are {sign}, as no scene makes them; "
                "check its polarity"
            )
        return notes
