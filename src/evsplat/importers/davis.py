"""A recording of a DAVIS: frames with their exposures and events, in one AEDAT file."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from evsplat.capture.write import CaptureWriter
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.events import EventRecording, EventStream, RecordedFrame, open_recording
from evsplat.footage import TimedPicture
from evsplat.importers.base import Importer, chosen_frames, need
from evsplat.importers.clock_offset import offset_or_changes
from evsplat.importers.option_types import (
    ClockOffset,
    Contrast,
    FileOption,
    Focal,
    FrameRange,
    Shrink,
)
from evsplat.importers.recorded import (
    add_recorded_frame,
    large_pictures,
    recorded_camera,
    shrunk_camera,
    write_recorded_events,
)
from evsplat.options.captures import Skip, Stop
from evsplat.options.declare import Flag
from evsplat.pictures.light import Transfer


@dataclass(frozen=True, kw_only=True)
class Davis(Importer):
    """A DAVIS recording (AEDAT 3.1 or 4) without poses: frames with exposure times, and events."""

    frames: FrameRange = None
    """First frame and the one after the last; by default all."""
    shrink: Shrink = 1
    """Make pictures and events smaller by this factor."""
    camera: FileOption = None
    """One camera as in capture.json."""
    focal: Focal = None
    """Focal length in pixels, instead of --camera; without both 60 degrees of view are guessed."""
    transfer: Transfer = "linear"
    """From the values of the pictures to light; a DAVIS stores what it measures."""
    clock_offset_us: ClockOffset = 0
    """Added to the events' times to get the clock of the pictures; auto finds it."""
    contrast: Contrast = None
    """Contrast thresholds of the sensor, brighter and darker, where they are known."""
    skip: Skip = 0
    """Leave out so many events at the beginning of the file, as of another recording in it."""
    stop: Stop = None
    """Leave out event N of the file, counted from 0, and all after it."""
    repair: Flag = False
    """Read on where the recording is damaged."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read the recording; see `Importer.write`."""
        recording = open_recording(
            need(source, "an AEDAT recording"),
            repair=self.repair,
            skip=self.skip,
            stop=self.stop,
        )
        spans, shapes = [], []
        for index, frame in enumerate(recording.frames()):
            spans.append(_span(source, index, frame))
            shapes.append(frame.image.shape[:2])
        repaired = recording.notes  # of the frames: a pass over the events begins anew
        first = next((piece for piece in recording.chunks() if len(piece)), None)
        if not spans or first is None:
            raise _incomplete(source, recording, has_frames=bool(spans))
        kept = chosen_frames(self.frames, list(range(len(spans))), source)
        # Such files count from 1970; a capture begins at 0.
        begin = spans[kept[0]][0]
        if self.frames is None and not isinstance(self.clock_offset_us, str):
            begin = min(begin, int(first.t[0]) + self.clock_offset_us)
        size = _size(recording, shapes[kept[0]], source)
        camera, focal, guessed = recorded_camera(self.camera, self.focal, size)
        camera, small = shrunk_camera({**camera, "transfer": self.transfer}, size, self.shrink)
        writer.add_camera("main", *small, **camera)
        clock_offset = offset_or_changes(self.clock_offset_us, camera, size)
        wanted, numbered = set(kept), enumerate(recording.frames())
        for index, frame in tqdm(numbered, "pictures", len(spans), leave=False):
            if index in wanted:
                exposure = spans[index][0] - begin, spans[index][1] - begin
                timed = TimedPicture(f"{index:06d}", sum(exposure) // 2, frame.image)
                add_recorded_frame(writer, timed, exposure, clock_offset, shrink=self.shrink)
        notes = write_recorded_events(
            writer,
            partial(_moved, recording, begin),
            source,
            size,
            clock_offset,
            contrast=self.contrast,
            exposed_only=self.frames is not None,
            shrink=self.shrink,
            one_file=True,
        )
        read = dict.fromkeys([*repaired, *recording.notes])  # both may end in the same packet
        notes = [*read, *notes, *large_pictures(small), *([guessed] if guessed else [])]
        writer.provenance |= {
            "source": f"DAVIS recording {source.name}",
            "focal": focal,
            "started_us": begin,
            "notes": notes,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
        }
        writer.leave_out_body()
        return notes


def _size(recording: EventRecording, shape: tuple[int, ...], source: Path) -> tuple[int, int]:
    """Width and height of a frame of (height, width) pixels, which must be those of the sensor."""
    height, width = shape
    if (width, height) != (recording.width, recording.height):
        raise DataError(
            f"{source}: its frames have {width}x{height} pixels and its events "
            f"{recording.width}x{recording.height}, expected one sensor with both; "
            "import a video of the frames and the events warped to it."
        )
    return width, height


def _incomplete(source: Path, recording: EventRecording, *, has_frames: bool) -> DataError:
    """The error of a recording without events, or without frames that are read."""
    if recording.format == "rosbag":
        # what a driver stamps its pictures with, and where it says the exposure, is its own
        going_on = command("import", "folder", "DIR", "--events", source, "--transfer", "linear")
        return DataError(
            f"{source}: of a ROS bag events alone are read, expected AEDAT 3.1 or 4 with frames "
            "and events; write its pictures into DIR/images and the start and end of each "
            "exposure, in microseconds of the bag's clock, a line each, into DIR/exposures.txt "
            f"(docs/event-formats.md has a program), and: {going_on}."
        )
    missing = f"no frames beside its events ({recording.format})" if not has_frames else "no events"
    return DataError(
        f"{source}: holds {missing}, expected AEDAT 3.1 or 4 with both; import the frames' video "
        "with 'evsplat import video CLIP --events FILE'."
    )


def _span(source: Path, index: int, frame: RecordedFrame) -> tuple[int, int]:
    """Exposure of a frame, which must have a length."""
    start, end = frame.exposure_us
    if end <= start:
        raise DataError(
            f"{source}: frame {index} is exposed from {start} to {end} us, expected an exposure "
            "with a length; record the exposure with the frames, or import their video."
        )
    return start, end


def _moved(recording: EventRecording, begin: int) -> Iterator[EventStream]:
    """The events, with ``begin`` as time 0."""
    for piece in recording.chunks():
        yield EventStream(np.asarray(piece.t) - begin, piece.x, piece.y, piece.p)
