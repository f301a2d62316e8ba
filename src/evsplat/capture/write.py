"""Writing a capture as a whole, piece by piece."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from evsplat.body.pose_errors import PoseSource
from evsplat.calibration.gain import GainMeter
from evsplat.calibration.moving_gain import MovingGainMeter
from evsplat.capture.body_file import key_poses, save_arrays, write_body
from evsplat.capture.finding import refuse_errors
from evsplat.capture.parse import FORMAT, VERSION
from evsplat.capture.parse_frames import default_split
from evsplat.capture.points import write_points
from evsplat.capture.validate import check_capture
from evsplat.errors import DataError
from evsplat.events import EventStream, write_events
from evsplat.events.homography import Homography, write_homography
from evsplat.files import (
    copy_file,
    make_folder,
    new_folder,
    remove_file,
    try_target,
    write_json,
)
from evsplat.names import checked_name
from evsplat.pictures.files import read_image, write_image
from evsplat.pictures.light import Transfer

_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


class CaptureWriter:
    """Builds a capture folder that appears under its name only when it is whole and valid.

    A context manager: pictures and events go to a hidden folder beside ``path`` as they come, so
    that memory grows by no more than some 20 KB with each picture. When the block ends well, the
    quick checks of `load_capture` run and the folder is renamed; on an error or Ctrl-C it is
    removed and ``path`` stays as it was.

        with CaptureWriter("my_capture") as writer:
            writer.add_camera("main", 640, 480, K, world_to_camera)
            writer.add_frame("0000", "main", picture, exposure_us=(0, 30_000))
            writer.set_body("default", times_us, poses, transl, betas=betas)

    ``provenance`` is a dictionary that may be added to at any time (docs/capture-format.md). With
    ``gains`` each picture is looked at as it comes, for `find_gains`.

    Raises:
        DataError: ``path`` exists (with ``overwrite`` only a capture is replaced), something does
            not fit, or the capture is not valid in the end.
    """

    def __init__(
        self,
        path: Path | str,
        name: str | None = None,
        *,
        overwrite: bool = False,
        gains: bool = False,
    ) -> None:
        self.path = Path(path)
        self.name = checked_name(name or self.path.resolve().name, "a capture")
        self.provenance: dict[str, Any] = {}
        self._cameras: dict[str, dict[str, Any]] = {}
        self._frames: list[dict[str, Any]] = []
        self._novel_views: list[dict[str, Any]] = []
        self._body: dict[str, str] | None = None
        self._without_body = False
        self._events: dict[str, Any] | None = None
        self._folder: Path | None = None
        self._overwrite = overwrite
        self._gains = GainMeter() if gains else None
        self._moving_gains = MovingGainMeter() if gains else None
        self._making = new_folder(self.path, replace=overwrite)
        self._check_target()

    def __enter__(self) -> Self:
        self._folder = self._making.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException:
            self._making.__exit__(*sys.exc_info())
            raise
        else:
            self._making.__exit__(kind, error, trace)
        finally:
            self._folder = None

    def add_camera(
        self,
        name: str,
        width: int,
        height: int,
        K: ArrayLike,
        world_to_camera: ArrayLike | None = None,
        *,
        distortion: Sequence[float] | None = None,
        transfer: Transfer | None = None,
    ) -> None:
        """Declare a camera: size in pixels, K (3, 3), pose (4, 4; identity where it moves).

        ``distortion`` holds OpenCV's k1, k2, p1, p2 (k3 (k4, k5, k6)) of the pictures as given,
        ``transfer`` the curve from their values to light; None: the power curve, exponent 2.2.
        """
        checked_name(name, "a camera")
        pose = np.eye(4) if world_to_camera is None else world_to_camera
        lens = None
        if distortion is not None and any(distortion):
            lens = {"model": "opencv", "coefficients": [float(value) for value in distortion]}
        self._cameras[name] = {
            "width": int(width),
            "height": int(height),
            "K": _numbers(K),
            "world_to_camera": _numbers(pose),
            "distortion": lens,
            **({} if transfer is None else {"transfer": transfer}),
        }

    def add_frame(
        self,
        name: str,
        camera: str,
        image: np.ndarray | Path | str,
        exposure_us: tuple[int, int],
        *,
        split: Literal["train", "test"] | None = None,
        sharp: np.ndarray | Path | str | Literal[True] | None = None,
        mask: np.ndarray | Path | str | None = None,
        world_to_camera: ArrayLike | None = None,
        gain: float | Sequence[float] | None = None,
    ) -> str:
        """Add the next frame and give its split; frames of a camera come in the order of time.

        Pictures are arrays (H, W) or (H, W, 3), coded as the camera says: uint8, uint16 or floats
        in [0, 1] (stored as 8 bit), or the path of a PNG, JPEG or WebP file that is copied as it
        is. ``sharp`` is the truth at mid-exposure; True: ``image`` is taken as sharp and is its own
        truth. ``mask`` is (H, W), the share of the person; booleans will do. ``gain`` is how much
        light the camera made of the scene's against other pictures, of all colours or of red,
        green and blue; see `find_gains`. Without ``split``, frames whose index modulo 10 is 7, 8
        or 9 are test.
        """
        checked_name(name, "a frame")
        index = len(self._frames)
        start, end = exposure_us
        entry: dict[str, Any] = {"name": name, "camera": camera}
        meter = self._gains if world_to_camera is None else self._moving_gains
        entry["image"] = self._store(f"images/{name}", camera, image, meter)
        entry["exposure_us"] = [int(start), int(end)]
        entry["split"] = split or default_split(index)
        if sharp is True:
            # A file of its own, so that a capture derived from this one can replace the picture.
            entry["sharp"] = f"sharp/{Path(entry['image']).name}"
            copy_file(self._root / entry["image"], self._root / entry["sharp"], link=True)
        elif sharp is not None:
            entry["sharp"] = self._store(f"sharp/{name}", camera, sharp)
        if mask is not None:
            entry["mask"] = self._store(f"masks/{name}", camera, mask)
        if world_to_camera is not None:
            entry["world_to_camera"] = _numbers(world_to_camera)
        if gain is not None:
            entry["gain"] = _numbers(gain)
        self._frames.append(entry)
        return entry["split"]

    def add_novel_view(
        self, camera: str, frame: str, time_us: int, image: np.ndarray | Path | str
    ) -> None:
        """Add a sharp picture that another camera took at the time of a frame."""
        stored = self._store(f"novel/{camera}/{frame}", camera, image)
        self._novel_views.append(
            {"camera": camera, "frame": frame, "time_us": int(time_us), "image": stored}
        )

    def find_gains(self) -> float:
        """Find what light each picture shows against the others, as automatic exposure changes it.

        For one camera, by what its pictures show of the scene; of one that moves each is laid over
        those before and after it. Gives the factor from the darkest to the brightest picture: 1
        where the camera's brightness is one, where that cannot be told, or where frames were given
        a gain, and then nothing is written.

        Raises:
            DataError: The writer was not made with ``gains``, so that nothing is known of them.
        """
        meter = self._moving_gains if self.camera_moves else self._gains
        if meter is None:
            raise DataError(
                f"{self.path}: the pictures were not looked at as they came; "
                "use CaptureWriter(..., gains=True) to have their gains found."
            )
        given = any("gain" in frame for frame in self._frames)
        several = len({frame["camera"] for frame in self._frames}) > 1
        gains = None if given or several else meter.gains()
        if gains is None or len(gains) < len(self._frames):
            return 1.0
        for frame, gain in zip(self._frames, gains.round(4).tolist(), strict=True):
            frame["gain"] = gain if len(gain) > 1 else gain[0]
        return float((gains.max(axis=0) / gains.min(axis=0)).max())

    def set_body(
        self,
        model: str,
        times_us: ArrayLike,
        poses: ArrayLike,
        transl: ArrayLike,
        *,
        rig: Mapping[str, Any] | None = None,
        betas: ArrayLike | None = None,
        gender: str | None = None,
        dense: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
        source: PoseSource | None = None,
        pose_std_rad: ArrayLike | None = None,
        transl_std_m: ArrayLike | None = None,
    ) -> None:
        """Give the body and its key poses: times (P,), poses (P, J, 3), root shifts (P, 3).

        A "rig" brings ``rig`` with the arrays of docs/capture-format.md, the other models
        ``betas`` (and ``gender``, all but "default"). ``dense`` are times, poses and shifts of the
        truth between key poses, for evaluation only. ``source`` says where the key poses come from;
        ``pose_std_rad`` (P, J) and ``transl_std_m`` (P, 3), how far they err (`PoseErrors`).
        """
        self._body = write_body(
            self._root,
            model,
            times_us,
            poses,
            transl,
            rig=rig,
            betas=betas,
            gender=gender,
            source=source,
            pose_std_rad=pose_std_rad,
            transl_std_m=transl_std_m,
        )
        if dense is not None:
            save_arrays(self._root / "body_dense.npz", key_poses(*dense))

    def leave_out_body(self) -> None:
        """Say that nobody has posed the person yet; without this a capture needs `set_body`.

        What `set_body` was given before is taken back.
        """
        for name in ("body.npz", "body_dense.npz"):
            remove_file(self._root / name)
        self._body = None
        self._without_body = True

    @property
    def has_body(self) -> bool:
        """True where `set_body` gave a body."""
        return self._body is not None

    @property
    def with_mask(self) -> tuple[int, int]:
        """How many frames were given a mask so far, and how many frames there are."""
        return sum("mask" in frame for frame in self._frames), len(self._frames)

    @property
    def camera_moves(self) -> bool:
        """True where a frame was given a pose of its own."""
        return any("world_to_camera" in frame for frame in self._frames)

    def set_events(
        self,
        events: EventStream | Iterable[EventStream],
        width: int,
        height: int,
        *,
        contrast_threshold: tuple[float, float] | None,
        simulated: bool,
        clock_offset_us: int = 0,
    ) -> int:
        """Write the event recording, one stream or its consecutive pieces; gives their count.

        ``width`` and ``height`` are those of the frames' camera. ``contrast_threshold`` is C+ and
        C- in log intensity, None where unknown. ``clock_offset_us`` is added to the events' times
        to get the camera's clock.
        """
        count = write_events(self._root / "events.h5", events)
        self._events = {
            "file": "events.h5",
            "width": int(width),
            "height": int(height),
            "contrast_threshold": None
            if contrast_threshold is None
            else [float(value) for value in contrast_threshold],
            "simulated": simulated,
            "clock_offset_us": int(clock_offset_us),
        }
        return count

    def add_homography(
        self, file: str, homography: Homography, size: tuple[int, int], certainty: dict[str, Any]
    ) -> None:
        """Keep by what events were brought into pictures of ``size``, as recorded, and how certain
        it is: in ``file``, and as ``provenance.homography``.
        """
        write_homography(self._root / file, homography, size)
        self.provenance["homography"] = {"matrix": _numbers(homography), "file": file, **certainty}

    @property
    def exposed_us(self) -> tuple[int, int]:
        """From the first exposure's start to the last one's end, of the frames added so far."""
        assert self._frames, "frames are added before this is asked"
        spans = np.array([frame["exposure_us"] for frame in self._frames])
        return int(spans[:, 0].min()), int(spans[:, 1].max())

    def set_points(self, points: ArrayLike, colours: ArrayLike | None = None) -> None:
        """Give first scene points (N, 3) in metres and their sRGB colours (N, 3) in [0, 1]."""
        write_points(
            self._root / "points.ply",
            np.asarray(points, dtype=np.float32),
            None if colours is None else np.asarray(colours, dtype=np.float32),
        )

    @property
    def _root(self) -> Path:
        assert self._folder is not None, "CaptureWriter is used in a with statement"
        return self._folder

    def _check_target(self) -> None:
        try_target(self.path)
        if not self.path.exists():
            return
        if not self._overwrite:
            raise DataError(f"{self.path}: already exists; choose another name or remove it first.")
        if not (self.path / "capture.json").is_file():
            raise DataError(
                f"{self.path}: exists and is not a capture, so it stays; choose another name."
            )

    def _store(
        self,
        stem: str,
        camera: str,
        image: np.ndarray | Path | str,
        meter: GainMeter | MovingGainMeter | None = None,
    ) -> str:
        """Write or copy a picture of a camera, looked at by ``meter``; its path in the capture."""
        if camera not in self._cameras:
            raise DataError(
                f"{self.path}: {stem} is of camera {camera!r}, expected one of "
                f"{sorted(self._cameras)}; add the camera first."
            )
        expected = self._cameras[camera]["width"], self._cameras[camera]["height"]
        if isinstance(image, np.ndarray):
            source, suffix, pixels = f"{self.path}: {stem}", ".png", image
        else:
            # Decoded whole: a copy of a picture that ends too early would be found much later.
            source, suffix = str(image), Path(image).suffix.lower()
            pixels = read_image(Path(image))
        size = pixels.shape[1::-1]
        if suffix not in _PICTURE_SUFFIXES:
            raise DataError(f"{source}: expected a PNG, JPEG or WebP picture; save it as PNG.")
        if size != expected:
            raise DataError(
                f"{source}: has {'x'.join(map(str, size))} pixels, expected "
                f"{expected[0]}x{expected[1]} of camera {camera!r}."
            )
        target = self._root / (stem + suffix)
        if isinstance(image, np.ndarray):
            make_folder(target.parent)
            write_image(target, image, source=source)
        else:
            copy_file(Path(image), target)
        if meter is not None:
            meter.add(pixels, self._cameras[camera].get("transfer", "power"))
        return stem + suffix

    def _finish(self) -> None:
        if self._body is None and not self._without_body:
            raise DataError(f"{self.path}: the capture was given no body; call set_body.")
        document = {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "cameras": self._cameras,
            "frames": self._frames,
            "novel_views": self._novel_views,
            "body": self._body,
            **({} if self._events is None else {"events": self._events}),
            "provenance": self.provenance,
        }
        write_json(self._root / "capture.json", document)
        _, findings = check_capture(self._root, deep=False)
        refuse_errors(findings, lambda file: self.path / file.relative_to(self._root))
        self._check_target()


def _numbers(matrix: ArrayLike) -> list[Any]:
    return np.asarray(matrix, dtype=np.float64).tolist()
