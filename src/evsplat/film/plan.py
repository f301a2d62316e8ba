"""The frames of a film of one run: the motion, and time and camera of each frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera, Capture, Frame
from evsplat.errors import ConfigError, DataError
from evsplat.film.camera_path import CameraPath, interpolated, read_camera_path
from evsplat.film.following import follow, in_view, straight, to_both_sides, whole_turn
from evsplat.film.frame_cache import FilmFrame
from evsplat.film.motion import load_motion_of
from evsplat.film.surroundings import CalmRoom, Painted
from evsplat.options import Film
from evsplat.training.reconstruction import GaussianReconstruction

_HELD_SECONDS = 4.0


@dataclass(frozen=True, eq=False)
class FilmPlan:
    """The frames of a film of one run."""

    capture: Capture
    reconstruction: GaussianReconstruction
    frames: list[FilmFrame]
    """Frames to draw; for events more than are shown."""
    oversampling: int
    """Frames drawn per picture shown."""
    human_distance_m: float
    """Distance of the person from the first camera, metres."""
    from_files: tuple[object, ...]
    """Times and poses of a motion and pixels of a background, for the film's digest."""
    surroundings: CalmRoom | Painted | None
    """What shows where nothing is."""

    @classmethod
    def of(cls, film: Film, capture: Capture, reconstruction: GaussianReconstruction) -> "FilmPlan":
        """Choose the motion, and time and camera of every frame.

        Raises:
            ConfigError: the capture or the method cannot give what is asked for.
        """
        from_files: tuple[object, ...] = ()
        recorded = reconstruction.track.to("cpu")
        if film.motion is not None:
            track = load_motion_of(
                film.motion, recorded, fps=film.motion_fps, in_place=film.in_place
            )
            reconstruction = reconstruction.in_new_motion(track)
            from_files = (
                track.times_us,
                *(value.numpy() for value in track.at(track.times_us.tolist())),
            )
        track = reconstruction.track.to("cpu")
        oversampling = 1
        if film.show == "events":
            if film.beside and capture.events is None:
                raise DataError(f"{capture.path}: has no events to put --beside the rendered ones.")
            oversampling = max(1, int(np.ceil(film.event_hz / (film.fps * film.slow))))
        names, times, clock = _times(film, capture, track, oversampling)
        recording = recorded_by(capture, film.camera)[0].camera
        view = film.camera or recording

        middle = _middle(track, times)
        # It may be another than the one that the film is seen by, which recorded nothing.
        recorder = capture.camera_at(recording, times[0]) if capture.is_static_camera else None
        # Up is where people stood in the recording: a motion may be a somersault.
        room = CalmRoom.of(recorded, track, recorder)
        surroundings = _surroundings(film, room)
        if isinstance(surroundings, Painted):
            from_files += (surroundings.picture.numpy(),)
        cameras = _cameras(film, capture, view, track, times, room.up)
        changes = [room.stand_back] if film.motion is not None else []
        if film.path in ("orbit", "swing"):
            changes.append(room.clear)
        elsewhere = any(camera is not recorder for camera in cameras)
        if surroundings is not None and recorder is not None and elsewhere:
            changes.append(room.soften)
        reconstruction = reconstruction.at_any_size()
        if changes:
            reconstruction = reconstruction.elsewhere(*changes)
        cameras = _of_height(cameras, film.size)
        frames = [FilmFrame(*fields) for fields in zip(names, times, clock, cameras, strict=True)]
        return cls(
            capture,
            reconstruction,
            frames,
            oversampling,
            float((middle - cameras[0].center().cpu()).norm()),
            from_files,
            surroundings,
        )

    def edges_us(self) -> list[int]:
        """Edges of the windows of event pictures, on the film's clock."""
        return [frame.clock_us for frame in self.frames[:: self.oversampling]]


def _times(
    film: Film, capture: Capture, track: BodyTrack, oversampling: int
) -> tuple[list[str], list[int], list[int]]:
    """Name, time of the person and time on the film's clock of every frame."""
    times: list[int]
    clock: list[int]
    if film.what == "test":
        held_out = [f for f in recorded_by(capture, film.camera) if f.split == "test"]
        if not held_out:
            raise DataError(f"{capture.path}: no frame has split 'test'; render the sequence.")
        times = [frame.mid_us for frame in held_out]
        return [frame.name for frame in held_out], times, times
    if film.motion is not None:
        first, last = 0, int(track.times_us[-1])
    else:
        mids = [frame.mid_us for frame in recorded_by(capture, film.camera)]
        first, last = mids[0], mids[-1]
    if film.at is not None:
        held = first + round(film.at * 1e6)
        if not first <= held <= last:
            since = "start of the motion" if film.motion is not None else "first mid-exposure"
            raise ConfigError(
                f"--at {film.at:g}: expected 0 to {(last - first) / 1e6:g} s from the {since}."
            )
        length = round((film.seconds or _HELD_SECONDS) * 1e6)
        clock = _even_steps(length, film.fps * oversampling)
        times = [held] * len(clock)
    else:
        length = last - first
        if film.seconds is not None:
            length = min(length, round(film.seconds * 1e6))
        rate_hz = film.fps * film.slow * oversampling
        times = clock = [first + at for at in _even_steps(length, rate_hz)]
    if film.show == "events":
        # Whole windows only.
        whole = (len(clock) - 1) // oversampling * oversampling + 1
        if whole < 2:
            raise ConfigError("--show events: the film is shorter than one picture; lengthen it.")
        times, clock = times[:whole], clock[:whole]
    return [f"{index:05d}" for index in range(len(times))], times, clock


def _cameras(
    film: Film,
    capture: Capture,
    view: str,
    track: BodyTrack,
    times_us: Sequence[int],
    up: Float[Tensor, "3"],
) -> list[Camera]:
    """The camera of each time: on a path, after a person who leaves its picture, or as recorded."""
    path = _camera_path(film, capture)
    if path is not None:
        last = max(1, len(times_us) - 1)
        return [path(index / last) for index in range(len(times_us))]
    start = capture.camera_at(view, times_us[0])
    free = film.motion is not None and film.camera is None
    if film.path is not None or (free and not in_view(start, track, times_us)):
        turn = {"orbit": whole_turn, "swing": to_both_sides}.get(film.path or "", straight)
        return follow(start, track, times_us, up, turn)
    if film.at is None and film.motion is None and not capture.is_static_camera:
        return list(capture.cameras_at(view, times_us))
    return [start] * len(times_us)


def _camera_path(film: Film, capture: Capture) -> CameraPath | None:
    """The path that does not depend on the person; None where the camera stays or follows."""
    if film.path in (None, "orbit", "swing"):
        return None
    if film.path == "interpolate":
        return interpolated(capture)
    assert film.path is not None
    if not Path(film.path).is_file():
        raise ConfigError(
            f"--path {film.path}: neither a file nor orbit, swing or interpolate; correct it."
        )
    return read_camera_path(film.path)


def _of_height(cameras: list[Camera], height: int | None) -> list[Camera]:
    """The same cameras with pictures so high; a camera that stands still stays one object."""
    if height is None:
        return cameras
    made: dict[int, Camera] = {}
    for camera in cameras:
        if id(camera) not in made:
            # Videos want even numbers.
            width = 2 * round(camera.width * height / camera.height / 2)
            made[id(camera)] = camera.resized(width, height)
    return [made[id(camera)] for camera in cameras]


def _surroundings(film: Film, room: CalmRoom) -> CalmRoom | Painted | None:
    if film.background is not None:
        return Painted.of(film.background)
    plain = film.show != "rgb" or film.parts != "all" or film.transparent or film.what == "test"
    return None if plain else room


def _middle(track: BodyTrack, times_us: Sequence[int]) -> torch.Tensor:
    """Middle of the box around the root joint's path, metres in the world."""
    root = track.at(times_us)[1] + track.body.rest_joints[0]
    return (root.amax(0) + root.amin(0)) / 2


def _even_steps(length_us: int, rate_hz: float) -> list[int]:
    """Instants from 0 to ``length_us`` at a rate, whole microseconds."""
    count = 1 + int(length_us * rate_hz / 1e6)
    return np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64).tolist()


def recorded_by(capture: Capture, camera: str | None) -> list[Frame]:
    """The frames of a camera, or of the first one where it recorded none, in the order of time."""
    recording = {frame.camera for frame in capture.frames}
    name = camera if camera in recording else capture.frames[0].camera
    return sorted((f for f in capture.frames if f.camera == name), key=lambda f: f.mid_us)
