"""Sharp pictures and what they bring along into the new capture: footage, or a sharp capture."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64

from evsplat.body import PoseSource
from evsplat.capture import BodyFile, Capture, CaptureWriter, Frame, load_capture
from evsplat.capture.camera_file import read_camera
from evsplat.capture.check_body import stated_body
from evsplat.capture.read import without_gain
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStore, EventStream
from evsplat.footage import Footage, TimedPicture
from evsplat.pictures.files import read_image
from evsplat.pictures.light import Transfer

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RecordedEvents:
    """Events for a capture: those that a source has of its own, or simulated ones."""

    pieces: Iterator[EventStream]
    contrast_threshold: tuple[float, float] | None
    simulated: bool


class Source(ABC):
    """Sharp pictures with what belongs to them."""

    footage: Footage
    camera: str
    """Name of the camera that took them."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Facts about the source for the provenance."""

    @property
    @abstractmethod
    def transfer(self) -> Transfer | None:
        """From values to light, as the camera states it."""

    @abstractmethod
    def declare(self, writer: CaptureWriter, transfer: Transfer) -> None:
        """Add the cameras, with that curve from values to light."""

    def extras(self, index: int) -> dict[str, Any]:
        """Options of `CaptureWriter.add_frame` that go with the source picture of that index."""
        return {}

    def split(self, index: int) -> Literal["train", "test"]:
        """The source's own split; `ConfigError` where it has none."""
        raise self._has_no("split")

    def events(self) -> RecordedEvents:
        """The source's own events; `ConfigError` where it has none."""
        raise self._has_no("events")

    @abstractmethod
    def complete(self, writer: CaptureWriter, frames: Mapping[str, int]) -> None:
        """Add the body and the rest; ``frames`` are names and mid-exposures of those made."""

    def _has_no(self, what: str) -> ConfigError:
        return ConfigError(
            f"--{what} source: {self.footage.path} is no capture and has no {what} of its own."
        )


def set_body(
    writer: CaptureWriter,
    body: BodyFile,
    dense: BodyFile | None,
    middles_us: Int64[np.ndarray, "M"],
) -> None:
    """Key poses are those at mid-exposures; all there are, or the denser truth, go beside them."""
    nearest = np.abs(body.times_us[None] - middles_us[:, None]).argmin(axis=1)
    kept = body.at_keys(np.isin(np.arange(len(body.times_us)), nearest))
    truth = dense or body
    writer.set_body(
        body.model,
        kept.times_us,
        kept.poses,
        kept.transl,
        rig=body.rig,
        betas=body.betas,
        gender=body.gender,
        dense=(truth.times_us, truth.poses, truth.transl),
        source=kept.source,
        pose_std_rad=kept.pose_std_rad,
        transl_std_m=kept.transl_std_m,
    )


_PIECE_US = 100_000


class CaptureSource(Source):
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

    @property
    def transfer(self) -> Transfer | None:
        """See `Source`."""
        return self._capture.metadata.transfers.get(self.camera)

    def declare(self, writer: CaptureWriter, transfer: Transfer) -> None:
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
                transfer=transfer,
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
        if capture.has_body:
            set_body(writer, capture.body_file, capture.dense_body_file, middles)
        else:
            writer.leave_out_body()
        for view in capture.novel_views:
            if view.frame in frames:
                writer.add_novel_view(view.camera, view.frame, view.time_us, view.image)
        points = capture.initial_points()
        if points is not None:
            writer.set_points(*points)
        if "masks" in capture.provenance:  # those that are found do not become given ones
            writer.provenance["masks"] = capture.provenance["masks"]


class _CaptureFootage:
    """The sharp pictures of a capture as they are stored, but for their gain (`Footage`)."""

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
        self._transfer = capture.transfer(capture.frames[0])

    def __iter__(self) -> Iterator[TimedPicture]:
        """See `Footage`."""
        for frame, file in zip(self._frames, self._files, strict=True):
            pixels = read_image(file)
            if frame.gain is not None:
                even = without_gain(file, pixels, frame.gain, self._transfer)
                pixels = (even * np.iinfo(pixels.dtype).max + 0.5).astype(pixels.dtype)
            yield TimedPicture(frame.name, frame.mid_us, pixels)


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


# Field of view across the longer side of a camera that nobody has described.
_NOMINAL_FOV_DEG = 60.0
_CAMERA_KEYS = ("width", "height", "K", "world_to_camera")


class FootageSource(Source):
    """Footage with a camera and body poses, if the user has them (`Source`).

    ``body`` is an npz like body.npz of a capture, on the footage's clock; ``camera`` a JSON file
    with one camera as in capture.json.
    """

    camera = "main"

    def __init__(
        self,
        footage: Footage,
        body: Path | None,
        camera: Path | None,
        pose_source: PoseSource | None,
    ) -> None:
        if body is not None and camera is None:
            raise ConfigError(
                f"{body}: poses mean nothing without the camera that saw them; give its "
                "description with --camera."
            )
        self.footage: Footage = footage
        self._body = None if body is None else stated_body(body, pose_source)
        self._camera = None
        if camera is not None:
            self._camera = read_camera(camera, footage.width, footage.height, _CAMERA_KEYS)

    def describe(self) -> dict[str, Any]:
        """See `Source`."""
        return {"footage": self.footage.path.name, "camera_known": self._camera is not None}

    @property
    def transfer(self) -> Transfer | None:
        """See `Source`."""
        return None if self._camera is None else self._camera["transfer"]

    def declare(self, writer: CaptureWriter, transfer: Transfer) -> None:
        """See `Source`."""
        width, height = self.footage.width, self.footage.height
        if self._camera is not None:
            writer.add_camera(self.camera, width, height, **{**self._camera, "transfer": transfer})
            return
        logger.warning(
            "No camera is given: one with %g degrees of view is written. Correct it in "
            "capture.json before you fit poses.",
            _NOMINAL_FOV_DEG,
        )
        focal = max(width, height) / 2 / np.tan(np.radians(_NOMINAL_FOV_DEG) / 2)
        K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
        writer.add_camera(self.camera, width, height, K, transfer=transfer)

    def complete(self, writer: CaptureWriter, frames: Mapping[str, int]) -> None:
        """See `Source`."""
        if self._body is None:
            logger.warning(
                "No body poses are given, and 'evsplat train' needs them; next: "
                "evsplat poses CAPTURE --out CAPTURE-posed (docs/poses.md)."
            )
            writer.leave_out_body()
            return
        set_body(writer, self._body, None, np.array(list(frames.values())))
