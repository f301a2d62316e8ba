"""All of a capture folder, read when asked for."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from tqdm import tqdm

from evsplat.camera import Camera
from evsplat.capture.body_file import BodyFile, body_from_arrays
from evsplat.capture.camera_track import CameraTrack
from evsplat.capture.check_body import check_dense
from evsplat.capture.finding import Findings
from evsplat.capture.metadata import Frame, Gain, Metadata, NovelView
from evsplat.capture.points import read_points
from evsplat.errors import DataError
from evsplat.events import EventStore
from evsplat.pictures.files import ImageCache, planar, read_image, to_grey, to_rgb, to_unit_range
from evsplat.pictures.light import Transfer, evened, shown
from evsplat.spread import evenly_spread
from evsplat.untrusted.arrays import read_plain_npz

IMAGE_CACHE_BYTES = 192 << 20
# A temporal median settles long before this many frames; more would only cost memory.
_MEDIAN_FRAMES, _MEDIAN_BYTES = 255, 1 << 30
"""Frames that a median is taken of at most, and bytes: 255 of 1024x1024 in colour, 43 of 4k."""
_LEAST_MEDIAN_FRAMES = 15


class CaptureReader:
    """Pictures, events and poses of a capture folder, held out or not, as `Capture` says."""

    def __init__(self, metadata: Metadata) -> None:
        self._metadata = metadata
        self._by_name = {frame.name: frame for frame in metadata.frames}
        self._images = ImageCache(IMAGE_CACHE_BYTES)
        self.path: Path = metadata.path
        self.name: str = metadata.name
        self.cameras: dict[str, Camera] = metadata.cameras
        self.frames: tuple[Frame, ...] = metadata.frames
        self.novel_views: tuple[NovelView, ...] = metadata.novel_views
        self.provenance: dict[str, Any] = metadata.provenance

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, {len(self.frames)} frames)"

    def with_nothing_held_out(self) -> Self:
        """The same recording with all frames for training, and so none for a test."""
        frames = tuple(replace(frame, split="train") for frame in self.frames)
        return type(self)(replace(self._metadata, frames=frames))

    def of_frames(self, frames: Sequence[Frame]) -> Self:
        """The same recording without its other frames, and the novel views at their times."""
        kept = tuple(replace(frame, index=index) for index, frame in enumerate(frames))
        names = {frame.name for frame in kept}
        views = [view for view in self.novel_views if view.frame in names]
        numbered = tuple(replace(view, index=index) for index, view in enumerate(views))
        return type(self)(replace(self._metadata, frames=kept, novel_views=numbered))

    def with_focal(self, focal_px: float) -> Self:
        """The same recording by cameras of another focal length, but for those of novel views."""
        cameras = dict(self.cameras)
        for name in {frame.camera for frame in self.frames}:
            cameras[name] = cameras[name].with_focal(focal_px)
        return type(self)(replace(self._metadata, cameras=cameras))

    @property
    def metadata(self) -> Metadata:
        """All of capture.json; what other parts need is given by the other members."""
        return self._metadata

    @property
    def train_frames(self) -> tuple[Frame, ...]:
        """Frames that a training sees."""
        return tuple(frame for frame in self.frames if frame.split == "train")

    @property
    def test_frames(self) -> tuple[Frame, ...]:
        """Frames held out for evaluation."""
        return tuple(frame for frame in self.frames if frame.split == "test")

    def frame(self, name: str) -> Frame:
        """The frame of that name."""
        if name not in self._by_name:
            raise DataError(f"{self.path}: no frame is named {name!r}.")
        return self._by_name[name]

    def camera(self, frame: Frame | str) -> Camera:
        """The pinhole camera at the mid-exposure of a frame, with a moving camera's own pose."""
        frame = self._frame(frame)
        camera = self.cameras[frame.camera]
        if frame.world_to_camera is None:
            return camera
        return Camera(camera.width, camera.height, camera.K, frame.world_to_camera)

    def cameras_at(self, camera: str, times_us: Sequence[int]) -> tuple[Camera, ...]:
        """The camera of that name at each time (`CameraTrack`); one object where it stands."""
        return self._tracks[camera].at(times_us)

    def camera_at(self, camera: str, time_us: int) -> Camera:
        """The camera of that name at a time (`cameras_at`)."""
        (there,) = self.cameras_at(camera, (time_us,))
        return there

    @functools.cached_property
    def _tracks(self) -> dict[str, CameraTrack]:
        frames: dict[str, list[Frame]] = {name: [] for name in self.cameras}
        for frame in self.frames:
            frames[frame.camera].append(frame)
        return {name: CameraTrack(camera, frames[name]) for name, camera in self.cameras.items()}

    def transfer(self, frame: Frame | str) -> Transfer:
        """From the values of a frame's pictures to light; the power curve where nothing is said."""
        return self._metadata.transfers.get(self._frame(frame).camera, "power")

    def shown(self, values: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Values of the frames' pictures, or of drawings of them, coded for a display."""
        return shown(values, self.transfer(self.frames[0]))

    def is_distorted(self, camera: str) -> bool:
        """True where the lens of a camera distorts, which reading pictures and events undoes."""
        return camera in self._metadata.distortions

    def undistort(
        self, camera: str, pixels: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Where pixels of a recorded picture are in the one that is read; NaN where nowhere."""
        lens = self._metadata.distortions.get(camera)
        return pixels if lens is None else lens.undistort(pixels)

    @property
    def has_others_masks(self) -> bool:
        """True where a frame has a mask that `evsplat masks` did not make."""
        return any(frame.mask for frame in self.frames) and "masks" not in self.provenance

    @property
    def takes_masks(self) -> bool:
        """Whether `evsplat masks --in-place` may add masks; they are made without distortion."""
        return not self.has_others_masks and not any(map(self.is_distorted, self.cameras))

    @property
    def is_static_camera(self) -> bool:
        """True where all frames come from one camera that stands still."""
        one = len({frame.camera for frame in self.frames}) == 1
        return one and all(frame.world_to_camera is None for frame in self.frames)

    def image(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The blurry picture of a frame."""
        frame = self._frame(frame)
        return to_rgb(self._picture(frame.image, frame.camera, frame.gain))

    def sharp(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The sharp truth at mid-exposure; for evaluation only, nothing else opens these files."""
        frame = self._frame(frame)
        if frame.sharp is None:
            raise DataError(
                f"{self.path / 'capture.json'}: frame {frame.name!r} names no sharp picture; "
                "evaluate against frames that do."
            )
        return to_rgb(self._picture(frame.sharp, frame.camera, frame.gain))

    def is_own_truth(self, frame: Frame | str) -> bool:
        """Whether a frame's own picture is its sharp truth, as in data sets of sharp video."""
        frame = self._frame(frame)
        return frame.sharp is not None and torch.equal(self.image(frame), self.sharp(frame))

    def mask(self, frame: Frame | str) -> Float[Tensor, "H W"] | None:
        """Share of the person per pixel in [0, 1]; None where the frame has no mask."""
        frame = self._frame(frame)
        return None if frame.mask is None else to_grey(self._picture(frame.mask, frame.camera))

    def novel_image(self, view: NovelView) -> Float[Tensor, "H W 3"]:
        """A sharp picture of another camera."""
        return to_rgb(self._picture(view.image, view.camera))

    @functools.cached_property
    def events(self) -> EventStore | None:
        """The event recording, on the camera's clock; None where the capture has none."""
        entry = self._metadata.events
        if entry is None:
            return None
        distortion = self._metadata.distortions.get(self.frames[0].camera)
        lookup = None if distortion is None else distortion.event_lookup()
        return EventStore(entry.file, entry.width, entry.height, entry.clock_offset_us, lookup)

    @property
    def contrast_threshold(self) -> tuple[float, float] | None:
        """C+ and C- of the event sensor in log intensity; None where unknown."""
        return None if self._metadata.events is None else self._metadata.events.contrast_threshold

    @property
    def events_simulated(self) -> bool:
        """True where the events were computed rather than recorded."""
        return self._metadata.events is not None and self._metadata.events.simulated

    @property
    def clock_offset_us(self) -> int:
        """Microseconds added to the event file's times to bring them to the camera's clock."""
        return 0 if self._metadata.events is None else self._metadata.events.clock_offset_us

    @property
    def up(self) -> tuple[float, float, float] | None:
        """Upwards in the world, of any length; None where capture.json does not say."""
        return self._metadata.up

    @property
    def has_body(self) -> bool:
        """True where body and poses are given."""
        return bool(self._metadata.body_model)

    @property
    def poses_found(self) -> str | None:
        """A sentence on how `evsplat poses` found the poses; None where they were given."""
        found = self.provenance.get("poses")
        policy = found.get("policy") if isinstance(found, dict) else None
        if not isinstance(found, dict) or not isinstance(policy, dict):
            return None
        seen = "training frames alone"
        if policy.get("use") == "everything":
            seen = "all frames, the held-out ones among them"
        elif policy.get("held_out_events"):
            seen = "training frames and the events of held-out intervals"
        refinement = found.get("refinement")
        drawn = isinstance(refinement, dict) and refinement.get("taken")
        return (
            f"Body poses were found by evsplat ({found.get('from')}"
            f"{', corrected by drawing the person' if drawn else ''}) from {seen}."
        )

    @property
    def poses_refined(self) -> bool:
        """Whether `evsplat poses` tried to correct what it had found by drawing the person."""
        found = self.provenance.get("poses")
        return isinstance(found, dict) and isinstance(found.get("refinement"), dict)

    @functools.cached_property
    def body_file(self) -> BodyFile:
        """The body and its key poses as stored; a `DataError` where there are none."""
        if not self.has_body:
            raise DataError(
                f"{self.path / 'capture.json'}: has no body; find the person's poses with: evsplat "
                f"poses {self.path} --out NEW; or write body.npz and name it under 'body' "
                "(docs/capture-format.md)."
            )
        path = self._metadata.body_file
        metadata = self._metadata
        arrays = read_plain_npz(path)
        return body_from_arrays(path, arrays, metadata.body_model, metadata.body_source)

    @functools.cached_property
    def dense_body_file(self) -> BodyFile | None:
        """True poses at many times (evaluation and ablation only); None where not given."""
        path = self.path / "body_dense.npz"
        if not self.has_body or not path.exists():
            return None
        arrays, findings = read_plain_npz(path), Findings()
        check_dense(path, arrays, self.body_file.poses.shape[1], findings)
        if findings.items:
            raise DataError(str(findings.items[0]))
        # Poses alone: what else there may be is the body's, which body.npz describes.
        keyed = {key: arrays[key] for key in ("times_us", "poses", "transl")}
        return body_from_arrays(path, keyed, self._metadata.body_model)

    def median_background(self) -> Float[Tensor, "H W 3"]:
        """Per-pixel temporal median of the train frames (at most 255, evenly spread).

        Of pictures above a megapixel so many that they take a gigabyte.
        """
        return self._median.clone()

    @functools.cached_property
    def _median(self) -> Tensor:
        if not self.is_static_camera:
            raise DataError(
                f"{self.path}: a median background needs one camera that stands still; this "
                "capture has a moving camera or several."
            )
        train = self.train_frames
        first = self._stored(train[0].image, train[0].camera, train[0].gain)
        each = first.size * (4 if any(frame.gain for frame in train) else first.itemsize)
        most = min(_MEDIAN_FRAMES, max(_LEAST_MEDIAN_FRAMES, _MEDIAN_BYTES // each))
        frames = evenly_spread(train, most)
        pictures = tqdm(frames, "background", unit="picture", leave=False, disable=None)
        stored = [self._stored(frame.image, frame.camera, frame.gain) for frame in pictures]
        if len({picture.dtype for picture in stored}) > 1:  # of 8 and of 16 bits, or with a gain
            stored = [to_unit_range(picture).numpy() for picture in stored]
        if len({picture.ndim for picture in stored}) > 1:  # grey ones among others
            stored = [to_rgb(torch.from_numpy(picture)).numpy() for picture in stored]
        stack = np.stack(stored)
        del stored
        counted = tqdm(range(stack.shape[1]), "median", unit="row", leave=False, disable=None)
        rows = [np.median(stack[:, row], axis=0) for row in counted]
        scale = 1.0 if stack.dtype == np.float32 else float(np.iinfo(stack.dtype).max)
        return to_rgb(torch.from_numpy((np.stack(rows) / scale).astype(np.float32)))

    def initial_points(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]] | None:
        """World points and their colours (sRGB in [0, 1]) of points.ply; None where not given."""
        path = self.path / "points.ply"
        if not path.exists():
            return None
        points, colours = read_points(path)
        return torch.from_numpy(points), torch.from_numpy(colours)

    def _frame(self, frame: Frame | str) -> Frame:
        return self.frame(frame if isinstance(frame, str) else frame.name)

    def _picture(self, path: Path, camera: str, gain: Gain | None = None) -> Tensor:
        return to_unit_range(self._stored(path, camera, gain))

    def _stored(self, path: Path, camera: str, gain: Gain | None) -> np.ndarray:
        return self._images.get((path, gain), lambda: self._decode(path, camera, gain))

    def _decode(self, path: Path, camera: str, gain: Gain | None) -> np.ndarray:
        pixels = read_image(path)
        expected = self.cameras[camera]
        if pixels.shape[:2] != (expected.height, expected.width):
            raise DataError(
                f"{path}: the picture has {pixels.shape[1]}x{pixels.shape[0]} pixels, expected "
                f"{expected.width}x{expected.height} of camera {camera!r}; resize it or correct "
                "the camera in capture.json."
            )
        distortion = self._metadata.distortions.get(camera)
        if distortion is not None:
            pixels = distortion.undistort_image(to_unit_range(pixels).numpy())
        if gain is not None:
            curve = self._metadata.transfers.get(camera, "power")
            pixels = without_gain(path, pixels, gain, curve)
        return planar(pixels)


def without_gain(
    path: Path, pixels: np.ndarray, gain: Gain, transfer: Transfer
) -> Float32[np.ndarray, "..."]:
    """Pixels of the file ``path`` in [0, 1], as if the camera had not changed their light."""
    if pixels.ndim == 2 and len(gain) > 1:
        raise DataError(
            f"{path}: is grey and has a gain of {len(gain)} colours in capture.json, expected one "
            "number; correct it, or give the picture in colours."
        )
    return evened(to_unit_range(pixels), torch.tensor(gain), transfer).numpy()
