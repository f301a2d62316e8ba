"""``export`` of one instant: the Gaussians of a run as a file that other programs read."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.body import Body, BodyTrack, up_axis
from evsplat.body.retarget import smallest_rotation
from evsplat.capture import Camera, Capture
from evsplat.errors import ConfigError, DataError
from evsplat.export.cloud import SplatCloud, cloud_of, joined
from evsplat.export.formats import write_gltf, write_ply, write_splat, write_spz
from evsplat.film.camera_path import check_camera
from evsplat.methods.reconstruction import Parts
from evsplat.options.runs import FileKind, UpAxis
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.run import Run

_AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
ALWAYS_Y_UP = {"spz": "right, up, back (RUB)", "gltf": "+Y up"}
"""Formats that define their axes."""


@dataclass(frozen=True)
class Instant:
    """A time, and the camera that sees the colours."""

    time_us: int
    camera: Camera
    camera_name: str
    label: str
    """The instant's part of file names."""


def instant_of(
    capture: Capture, *, time_s: float | None, frame: str | None, camera: str | None
) -> Instant:
    """The instant asked for; without any, the mid-exposure in the middle of the recording.

    ``time_s`` counts seconds from the first frame's mid-exposure, ``frame`` names a frame, whose
    mid-exposure is taken. Colours are seen by ``camera``, or by the camera of the nearest frame.
    """
    frames = sorted(capture.frames, key=lambda f: f.mid_us)
    chosen = frames[len(frames) // 2]
    first, last = frames[0].mid_us, frames[-1].mid_us
    if frame is not None:
        by_name = {f.name: f for f in frames}
        if frame not in by_name:
            raise ConfigError(
                f"--frame {frame}: {capture.path} has no such frame; they are "
                f"{frames[0].name} to {frames[-1].name}."
            )
        chosen = by_name[frame]
    time_us = chosen.mid_us
    if time_s is not None:
        time_us = first + round(time_s * 1e6)
        if not first <= time_us <= last:
            raise ConfigError(
                f"--time {time_s:g}: expected 0 to {(last - first) / 1e6:g} s, from the first "
                "mid-exposure to the last."
            )
        chosen = min(frames, key=lambda f: abs(f.mid_us - time_us))
    name = camera or chosen.camera
    check_camera(capture, name)
    label = f"frame-{frame}" if frame is not None else f"{(time_us - first) / 1e6:.3f}s"
    return Instant(time_us, capture.camera_at(name, time_us), name, label)


def cloud_at(
    source: GaussianReconstruction, camera: Camera, time_us: int, parts: Parts
) -> SplatCloud:
    """The Gaussians of one instant in the capture's world, coloured as ``camera`` sees them."""
    splats = source.splats(camera, [time_us], parts=parts)
    certain = None if parts == "scene" else source.certainties()
    return joined([cloud_of(splats[0], seen=certain), *map(cloud_of, splats[1:])])


def facts_of(run: Run) -> dict[str, Any]:
    """Capture, method and step of the Gaussians, for formats that have room for them."""
    return {"capture": run.capture.name, "method": run.method, "iteration": run.iteration}


def rest_track(body: Body) -> BodyTrack:
    """The body in its rest pose, where the world is that of the rest pose."""
    joints = len(body.parents)
    return BodyTrack(body, np.zeros(1, np.int64), np.zeros((1, joints, 3)), np.zeros((1, 3)))


def file_rotation(track: BodyTrack, kind: str, up: UpAxis | None) -> np.ndarray:
    """Rotation (3, 3) from the world of ``track`` to the axes of the file."""
    if kind in ALWAYS_Y_UP:
        if up == "z":
            raise ConfigError(
                f"--up z: the axes of .{kind} files are {ALWAYS_Y_UP[kind]} by definition; "
                "leave --up out, or write a .ply."
            )
        up = "y"
    if up is None:
        return np.eye(3)
    return smallest_rotation(up_axis(track).double().numpy(), np.array(_AXES[up]))


def write_file(
    path: Path, kind: FileKind, cloud: SplatCloud, rotation: np.ndarray, facts: Mapping[str, Any]
) -> None:
    """Write one cloud, turned to the axes of the file; ``facts`` go where a format has room."""
    if len(cloud) == 0:
        raise DataError(f"{path}: there is no Gaussian to write.")
    turned = cloud.rotated(rotation)
    facts = {**facts, "unit": "metre", "world_to_file_rotation": rotation.tolist()}
    lines = (
        f"{name}: {value}".encode("ascii", "replace").decode() for name, value in facts.items()
    )
    comments = ["written by evsplat", *(" ".join(line.split()) for line in lines)]
    writers: dict[str, Callable[[], None]] = {
        "ply": lambda: write_ply(path, turned, comments=comments),
        "spz": lambda: write_spz(path, turned),
        "splat": lambda: write_splat(path, turned),
        "gltf": lambda: write_gltf(path, turned, extras=facts),
    }
    writers[kind]()
