"""A recording of a DAVIS: frames with their exposures and events, in one AEDAT file."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from evsplat.capture.write import CaptureWriter
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.events import EventRecording, EventStream, RecordedFrame, open_recording
from evsplat.importers.base import Importer, chosen_frames, need
from evsplat.importers.option_types import Contrast, FileOption, Focal, FrameRange
from evsplat.importers.recorded import recorded_camera
from evsplat.options.declare import Flag
from evsplat.pictures.light import Transfer


@dataclass(frozen=True, kw_only=True)
class Davis(Importer):
    """A DAVIS recording (AEDAT 3.1 or 4) without poses: frames with exposure times, and events."""

    frames: FrameRange = None
    """First frame and the one after the last; by default all."""
    camera: FileOption = None
    """One camera as in capture.json."""
    focal: Focal = None
    """Focal length in pixels, instead of --camera; without both 60 degrees of view are guessed."""
    transfer: Transfer = "linear"
    """From the values of the pictures to light; a DAVIS stores what it measures."""
    contrast: Contrast = None
    """Contrast thresholds of the sensor, brighter and darker, where they are known."""
    repair: Flag = False
    """Read on where the recording is damaged."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read the recording; see `Importer.write`."""
        recording = open_recording(need(source, "an AEDAT recording"), repair=self.repair)
        spans = [_span(source, index, frame) for index, frame in enumerate(recording.frames())]
        first = next((piece for piece in recording.chunks() if len(piece)), None)
        if not spans or first is None:
            raise _incomplete(source, recording, has_frames=bool(spans))
        kept = chosen_frames(self.frames, list(range(len(spans))), source)
        # Such files count from 1970; a capture begins at 0.
        begin = spans[kept[0]][0]
        if self.frames is None:
            begin = min(begin, int(first.t[0]))
        end = max(stop for _, stop in spans[kept[0] : kept[-1] + 1])
        size = self._add_frames(recording, source, writer, spans, kept, begin)
        writer.set_events(
            _moved(recording, begin, None if self.frames is None else end),
            *size,
            contrast_threshold=self.contrast,
            simulated=False,
        )
        return self._notes(recording, source, writer, size, begin)

    def _add_frames(
        self,
        recording: EventRecording,
        source: Path,
        writer: CaptureWriter,
        spans: list[tuple[int, int]],
        kept: list[int],
        begin: int,
    ) -> tuple[int, int]:
        """Camera and frames; gives the size in pixels, which is that of the sensor."""
        wanted, size = set(kept), (0, 0)
        numbered = enumerate(recording.frames())
        for index, frame in tqdm(numbered, "pictures", len(spans), leave=False):
            if index not in wanted:
                continue
            height, width = frame.image.shape[:2]
            if size == (0, 0):
                size = width, height
                if size != (recording.width, recording.height):
                    raise DataError(
                        f"{source}: its frames have {width}x{height} pixels and its events "
                        f"{recording.width}x{recording.height}, expected one sensor with both; "
                        "import a video of the frames and the events warped to it."
                    )
                camera = recorded_camera(self.camera, self.focal, size)[0]
                writer.add_camera("main", *size, **{**camera, "transfer": self.transfer})
            exposure = spans[index][0] - begin, spans[index][1] - begin
            writer.add_frame(f"{index:06d}", "main", frame.image, exposure)
        return size

    def _notes(
        self,
        recording: EventRecording,
        source: Path,
        writer: CaptureWriter,
        size: tuple[int, int],
        begin: int,
    ) -> list[str]:
        _, focal, guessed = recorded_camera(self.camera, self.focal, size)
        notes = [*recording.notes, *([guessed] if guessed else [])]
        writer.provenance |= {
            "source": f"DAVIS recording {source.name}",
            "focal": focal,
            "started_us": begin,
            "notes": notes,
        }
        writer.leave_out_body()
        return notes


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


def _moved(recording: EventRecording, begin: int, end: int | None) -> Iterator[EventStream]:
    """The events from ``begin`` on (to before ``end``), which becomes time 0."""
    for piece in recording.chunks():
        last = int(piece.t[-1]) + 1 if end is None and len(piece) else end or 0
        part = piece.between(begin, last)
        yield EventStream(np.asarray(part.t) - begin, part.x, part.y, part.p)
