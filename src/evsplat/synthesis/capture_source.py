"""A capture whose frames are sharp (an imported data set) as a source."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evsplat.capture import Capture, CaptureWriter, Frame, load_capture
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStore, EventStream
from evsplat.footage import Footage, TimedPicture
from evsplat.pictures.files import read_image
from evsplat.synthesis.source import RecordedEvents, set_body

_PIECE_US = 100_000


class CaptureSource:
    """Camera, poses, masks, other views and first points go on to the new capture (`Source`).

    The sharp pictures are the frames' ``sharp`` where all have one, else their ``image``.
    """

    def __init__(self, path: Path) -> None:
        self._capture = load_capture(path)
        self.footage: Footage = _CaptureFootage(self._capture)
        self.camera = self._capture.frames[0].camera

    def describe(self) -> dict[str, Any]:
        """See `Source`."""
        return {"capture": self._capture.name, "provenance": self._capture.provenance}

    def declare(self, writer: CaptureWriter) -> None:
        """See `Source`; lenses stay, pictures are handled as they were recorded."""
        for name, camera in self._capture.cameras.items():
            lens = self._capture.metadata.distortions.get(name)
            writer.add_camera(
                name,
                camera.width,
                camera.height,
                camera.K,
                camera.world_to_camera,
                distortion=None if lens is None else lens.coefficients,
            )

    def extras(self, index: int) -> dict[str, Any]:
        """See `Source`."""
        frame = self._capture.frames[index]
        return {"mask": frame.mask, "world_to_camera": frame.world_to_camera}

    def split(self, index: int) -> Literal["train", "test"]:
        """See `Source`."""
        return self._capture.frames[index].split

    def events(self) -> RecordedEvents:
        """See `Source`; with the lens as it is."""
        entry = self._capture.metadata.events
        if entry is None:
            raise ConfigError(
                f"{self._capture.path}: has no events to keep; leave --events out to simulate them."
            )
        store = EventStore(entry.file, entry.width, entry.height, entry.clock_offset_us)
        return RecordedEvents(_pieces(store), entry.contrast_threshold, entry.simulated)

    def complete(self, writer: CaptureWriter, frames: Mapping[str, int]) -> None:
        """See `Source`."""
        capture = self._capture
        middles = np.array(list(frames.values()))
        set_body(writer, capture.body_file, capture.dense_body_file, middles)
        for view in capture.novel_views:
            if view.frame in frames:
                writer.add_novel_view(view.camera, view.frame, view.time_us, view.image)
        points = capture.initial_points()
        if points is not None:
            writer.set_points(*points)


class _CaptureFootage:
    """The sharp pictures of a capture as they are stored (`Footage`)."""

    def __init__(self, capture: Capture) -> None:
        self.path = capture.path
        self._frames = capture.frames
        cameras = sorted({frame.camera for frame in capture.frames})
        if len(cameras) > 1:
            raise DataError(
                f"{capture.path}: frames of {len(cameras)} cameras ({', '.join(cameras)}), "
                "expected one; keep the frames of one in capture.json."
            )
        camera = capture.cameras[cameras[0]]
        self.width, self.height = camera.width, camera.height
        self.times_us = np.array([frame.mid_us for frame in capture.frames], dtype=np.int64)
        self._files = _sharp_files(capture)

    def __iter__(self) -> Iterator[TimedPicture]:
        """See `Footage`."""
        for frame, file in zip(self._frames, self._files, strict=True):
            yield TimedPicture(frame.name, frame.mid_us, read_image(file))


def _sharp_files(capture: Capture) -> list[Path]:
    without = [frame for frame in capture.frames if frame.sharp is None]
    if 0 < len(without) < len(capture.frames):
        raise DataError(
            f"{capture.path / 'capture.json'}: {len(without)} of {len(capture.frames)} frames have "
            f"no sharp picture (first: {without[0].name!r}), expected one for all or for none."
        )
    return [_file(frame) for frame in capture.frames]


def _file(frame: Frame) -> Path:
    return frame.image if frame.sharp is None else frame.sharp


def _pieces(store: EventStore) -> Iterator[EventStream]:
    start, end = store.time_range_us
    for first in range(start, end, _PIECE_US):
        yield store.between(first, min(end, first + _PIECE_US))
    store.close()
