"""Reading a COLMAP reconstruction in its text form: cameras, poses of pictures, points."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.errors import DataError
from evsplat.importers.base import GUIDE, SourceCamera, rigid
from evsplat.untrusted.faults import open_text

# Model -> places of fx, fy, cx, cy and of OpenCV's distortion coefficients among the parameters.
_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None)),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Cameras and points of COLMAP, in its own scale; pixel centres at 0.5 as in captures."""

    cameras: dict[str, SourceCamera]
    """Cameras by the name of the picture."""
    shared: bool
    """True where all pictures have the same intrinsics."""
    points: Float[np.ndarray, "N 3"]
    colours: Float[np.ndarray, "N 3"]
    """Coded RGB in [0, 1]."""


def read_colmap(folder: Path) -> Reconstruction:
    """Read cameras.txt, images.txt and points3D.txt (optional) of a folder or its ``0``."""
    place = next((p for p in (folder, folder / "0") if (p / "images.txt").exists()), None)
    if place is None:
        binary = any((p / "images.bin").exists() for p in (folder, folder / "0"))
        remedy = "convert it: colmap model_converter --output_type TXT" if binary else f"{GUIDE}"
        raise DataError(f"{folder}: holds no images.txt, expected COLMAP's text form; {remedy}.")
    intrinsics = _read_cameras(place / "cameras.txt")
    cameras: dict[str, SourceCamera] = {}
    used = set()
    for number, words in _image_lines(place / "images.txt"):
        where = f"{place / 'images.txt'}: line {number}"
        try:
            w, x, y, z = (float(word) for word in words[1:5])
            shift = np.array([float(word) for word in words[5:8]])
            lens, name = int(words[8]), " ".join(words[9:])
        except (ValueError, IndexError):
            raise DataError(
                f"{where}: found {' '.join(words)[:60]!r}, expected IMAGE_ID QW QX QY QZ TX TY TZ "
                "CAMERA_ID NAME."
            ) from None
        if lens not in intrinsics:
            raise DataError(f"{where}: names camera {lens}, which cameras.txt does not hold.")
        K, distortion = intrinsics[lens]
        if not 0 < math.hypot(x, y, z, w) < math.inf:
            raise DataError(
                f"{where}: QW QX QY QZ are {' '.join(words[1:5])[:60]}, expected a rotation."
            )
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        cameras[name] = SourceCamera(K, rigid(turn, shift, where), distortion)
        used.add(lens)
    if not cameras:
        raise DataError(f"{place / 'images.txt'}: names no picture, expected at least one.")
    points, colours = _read_points(place / "points3D.txt")
    return Reconstruction(cameras, len(used) == 1, points, colours)


def _read_cameras(path: Path) -> dict[int, tuple[np.ndarray, tuple[float, ...] | None]]:
    cameras = {}
    for number, words in _lines(path):
        model = words[1] if len(words) > 1 else ""
        if model not in _MODELS:
            raise DataError(
                f"{path}: line {number}: found camera model {model!r}, expected one of "
                f"{', '.join(_MODELS)}; undistort the pictures with COLMAP first."
            )
        linear, lens = _MODELS[model]
        try:
            camera = int(words[0])
        except ValueError:
            raise DataError(
                f"{path}: line {number}: found {words[0][:60]!r}, expected the number of a camera."
            ) from None
        try:
            values = [float(word) for word in words[4:]]
            fx, fy, cx, cy = (values[place] for place in linear)
            distortion = tuple(0.0 if place is None else values[place] for place in lens)
        except (ValueError, IndexError):
            raise DataError(
                f"{path}: line {number}: found {len(words) - 4} parameters of a {model} camera, "
                "expected more numbers."
            ) from None
        if not np.isfinite(values).all():
            raise DataError(
                f"{path}: line {number}: found {' '.join(words[4:])[:60]!r}, expected finite "
                "numbers."
            )
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        cameras[camera] = (K, distortion or None)
    return cameras


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.exists():
        return np.zeros((0, 3)), np.zeros((0, 3))
    rows = []
    for number, words in _lines(path):
        try:
            rows.append([float(word) for word in words[1:7]])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != 6 or not np.isfinite(rows[-1]).all():
            raise DataError(
                f"{path}: line {number}: expected POINT3D_ID X Y Z R G B, finite numbers, and more."
            )
    table = np.array(rows).reshape(-1, 6)
    return table[:, :3], table[:, 3:] / 255


def _image_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Every other line: the one between holds the picture's points and may be empty."""
    wanted = True
    for number, line in _text(path):
        if line.startswith("#"):
            continue
        if wanted and not line.strip():
            continue
        if wanted:
            yield number, line.split()
        wanted = not wanted


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, line in _text(path):
        if line.strip() and not line.startswith("#"):
            yield number, line.split()


def _text(path: Path) -> Iterator[tuple[int, str]]:
    if not path.exists():
        raise DataError(f"{path}: not found, expected COLMAP's text form; {GUIDE}.")
    try:
        with open_text(path) as file:
            yield from enumerate(file, start=1)
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not text, expected COLMAP's text form.") from None
