"""A film put together for one run: who moves how, and where the camera is at each exposure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from evsplat.body import BodyTrack, up_axis
from evsplat.capture import Camera, Capture, Frame, load_body_track
from evsplat.errors import ConfigError, DataError
from evsplat.film.camera_path import (
    CameraPath,
    camera_at,
    interpolated,
    orbit,
    read_camera_path,
    swing,
)
from evsplat.film.kept import Shot
from evsplat.film.motion import load_motion_of
from evsplat.methods.reconstruction import Posable, Reconstruction
from evsplat.methods.trivial import nearest_in_time
from evsplat.options import Film

_HELD_SECONDS = 4.0


@dataclass(frozen=True)
class Instant:
    """One picture to draw."""

    name: str
    """File name without ending, where pictures are written one by one."""
    time_us: int
    frame: Frame
    """The recorded frame nearest in time: the picture for ``beside``."""


def rendered_instants(
    capture: Capture,
    what: Literal["sequence", "test"],
    *,
    rate_hz: float = 30.0,
    camera: str | None = None,
) -> list[Instant]:
    """Say which instants of the recording are drawn.

    ``test``: mid-exposure of each held-out frame. ``sequence``: from the first to the last
    mid-exposure (poses are known between them), ``rate_hz`` instants per second of the recording.
    Frames are those of ``camera`` where it recorded any, else those of the first camera.
    """
    frames = recorded_by(capture, camera)
    if what == "test":
        frames = [frame for frame in frames if frame.split == "test"]
        if not frames:
            raise DataError(f"{capture.path}: no frame has split 'test'; render the sequence.")
        return [Instant(frame.name, frame.mid_us, frame) for frame in frames]
    mids = np.array([frame.mid_us for frame in frames])
    times = [int(mids[0]) + at for at in _even_steps(int(mids[-1] - mids[0]), rate_hz)]
    return [
        Instant(f"{index:05d}", time, nearest_in_time(frames, time))
        for index, time in enumerate(times)
    ]


@dataclass(frozen=True, eq=False)
class Scene:
    """A film put together for one run."""

    capture: Capture
    reconstruction: Reconstruction
    shots: list[Shot]
    """What is exposed; for events more than what is seen."""
    step: int
    """Exposures per picture."""
    person_m: Callable[[], float]
    """Distance of the person from the first camera."""
    poses: tuple[object, ...]
    """What a motion is told apart by."""

    @classmethod
    def of(cls, film: Film, capture: Capture, reconstruction: Reconstruction) -> "Scene":
        """Find out who moves how and where the camera is at every exposure.

        Raises:
            ConfigError: what the capture or the method cannot give.
        """
        poses: tuple[object, ...] = ()
        recorded = reconstruction.track if isinstance(reconstruction, Posable) else None
        if film.motion is not None:
            if not isinstance(reconstruction, Posable):
                raise ConfigError(
                    f"--motion: method {reconstruction.name} draws the recorded motion only; it "
                    "cannot be posed freely."
                )
            track = load_motion_of(
                film.motion, reconstruction.track, fps=film.motion_fps, in_place=film.in_place
            )
            reconstruction = reconstruction.following(track)
            poses = (
                track.times_us,
                *(value.numpy() for value in track.at(track.times_us.tolist())),
            )
        person = reconstruction.track if isinstance(reconstruction, Posable) else None
        step = 1
        if film.show == "events":
            if film.beside and capture.events is None:
                raise DataError(f"{capture.path}: has no events to put --beside the rendered ones.")
            step = max(1, int(np.ceil(film.event_hz / (film.fps * film.slow))))
        names, times, clock = _times(film, capture, person, step)
        recording = recorded_by(capture, film.camera)[0].camera
        view = film.camera or recording

        def middle() -> torch.Tensor:
            return _middle((person or load_body_track(capture)).to("cpu"), times)

        def up() -> torch.Tensor:
            # Where people stood in the recording: a motion may be a somersault.
            return up_axis((recorded or load_body_track(capture)).to("cpu"))

        start = camera_at(capture, view, times[0])
        way = _camera_path(film, capture, start, up, middle)
        if way is not None:
            last = max(1, len(times) - 1)
            cameras = [way(index / last) for index in range(len(times))]
        elif film.at is None and film.motion is None and not capture.is_static_camera:
            cameras = [camera_at(capture, view, time) for time in times]
        else:
            cameras = [start] * len(times)
        shots = [Shot(*fields) for fields in zip(names, times, clock, cameras, strict=True)]
        return cls(
            capture,
            reconstruction,
            shots,
            step,
            lambda: float((middle() - cameras[0].center().cpu()).norm()),
            poses,
        )

    def edges_us(self) -> list[int]:
        """Where the windows of event pictures begin and end, on the film's clock."""
        return [shot.clock_us for shot in self.shots[:: self.step]]


def _times(
    film: Film, capture: Capture, track: BodyTrack | None, step: int
) -> tuple[list[str], list[int], list[int]]:
    """Name, time of the person and time on the film's clock of every exposure."""
    times: list[int]
    clock: list[int]
    if film.what == "test":
        instants = rendered_instants(capture, "test", camera=film.camera)
        times = [instant.time_us for instant in instants]
        return [instant.name for instant in instants], times, times
    if film.motion is not None:
        assert track is not None
        first, last = 0, int(track.times_us[-1])
    else:
        mids = [frame.mid_us for frame in recorded_by(capture, film.camera)]
        first, last = mids[0], mids[-1]
    if film.at is not None:
        held = round(film.at * 1e6)
        if not first <= held <= last:
            raise ConfigError(
                f"--at {film.at:g}: expected {first / 1e6:g} to {last / 1e6:g} s, where the "
                "person's pose is known."
            )
        length = round((film.seconds or _HELD_SECONDS) * 1e6)
        clock = _even_steps(length, film.fps * step)
        times = [held] * len(clock)
    else:
        length = last - first
        if film.seconds is not None:
            length = min(length, round(film.seconds * 1e6))
        times = clock = [first + at for at in _even_steps(length, film.fps * film.slow * step)]
    if film.show == "events":
        # Whole windows only.
        whole = (len(clock) - 1) // step * step + 1
        if whole < 2:
            raise ConfigError("--show events: the film is shorter than one picture; lengthen it.")
        times, clock = times[:whole], clock[:whole]
    return [f"{index:05d}" for index in range(len(times))], times, clock


def _camera_path(
    film: Film,
    capture: Capture,
    start: Camera,
    up: Callable[[], torch.Tensor],
    middle: Callable[[], torch.Tensor],
) -> CameraPath | None:
    if film.path is None:
        return None
    if film.path in ("orbit", "swing"):
        around = orbit if film.path == "orbit" else swing
        return around(start, middle(), up())
    if film.path == "interpolate":
        return interpolated(capture)
    if not Path(film.path).is_file():
        raise ConfigError(
            f"--path {film.path}: neither a file nor orbit, swing or interpolate; correct it."
        )
    return read_camera_path(film.path)


def _middle(track: BodyTrack, times_us: Sequence[int]) -> torch.Tensor:
    """Middle of the way of the body's root."""
    root = track.at(times_us)[1] + track.body.rest_joints[0]
    return (root.amax(0) + root.amin(0)) / 2


def _even_steps(length_us: int, rate_hz: float) -> list[int]:
    """Instants from 0 to ``length_us`` at a rate, whole microseconds."""
    count = 1 + int(length_us * rate_hz / 1e6)
    return np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64).tolist()


def recorded_by(capture: Capture, camera: str | None) -> list[Frame]:
    """Return the frames of one camera in the order of time."""
    recording = {frame.camera for frame in capture.frames}
    name = camera if camera in recording else capture.frames[0].camera
    return sorted((f for f in capture.frames if f.camera == name), key=lambda f: f.mid_us)
