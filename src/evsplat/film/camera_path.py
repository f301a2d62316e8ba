"""Camera paths that do not follow the person: as recorded, from camera to camera, from a file.

The file is JSON:

    {"format": "evsplat-camera-path", "version": 1, "width": 640, "height": 480,
     "keys": [{"at": 0.0, "eye": [0, -3, 1.5], "target": [0, 0, 1], "up": [0, 0, 1],
               "fov_y_deg": 40},
              {"at": 1.0, "world_to_camera": [[...], [...], [...], [...]],
               "K": [[...], [...], [...]]}]}

``at`` is the share of the film, from 0 to 1. A key has either ``eye``, ``target`` and ``up`` or
``world_to_camera`` (OpenCV axes, metres), and either ``fov_y_deg`` (the principal point is then the
middle) or ``K`` in pixels.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp
from torch import Tensor

from evsplat.capture import Camera, Capture, Frame
from evsplat.errors import ConfigError, DataError
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import read_json

CameraPath = Callable[[float], Camera]
"""The camera at a share of the film, 0 to 1."""

_LARGEST = 1e6
"""Of the numbers of a key: metres, pixels or degrees."""
_LEAST_STEP = 1e-6


def check_camera(capture: Capture, name: str) -> None:
    """Raise a `ConfigError` where the capture has no camera of this name."""
    if name not in capture.cameras:
        known = ", ".join(capture.cameras)
        raise ConfigError(f"--camera {name}: the capture has no such camera, only {known}.")


def through(shares: Sequence[float], cameras: Sequence[Camera]) -> CameraPath:
    """A smooth path through cameras, each at its share of the film; it stands before and after.

    Centres and intrinsics follow a cubic spline, orientations scipy's rotation spline; with two
    cameras both are straight. The size of the picture is the first camera's.
    """
    if len(cameras) == 1:
        return lambda share: cameras[0]
    at = np.asarray(shares, np.float64)
    rotations = Rotation.from_matrix(
        np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])
    )
    values = np.stack(
        [
            np.concatenate((camera.center().double().numpy(), _intrinsics(camera, cameras[0])))
            for camera in cameras
        ]
    )
    turn = RotationSpline(at, rotations) if len(at) > 2 else Slerp(at, rotations)
    spline = CubicSpline(at, values, bc_type="natural")

    def camera(share: float) -> Camera:
        share = float(np.clip(share, at[0], at[-1]))
        center, (fx, fy, cx, cy) = spline(share)[:3], spline(share)[3:]
        K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)
        return _placed(replace(cameras[0], K=K), turn(share).as_matrix(), center)

    return camera


def interpolated(capture: Capture) -> CameraPath:
    """Through the capture's cameras in their order, or through the poses of its moving one."""
    if not capture.is_static_camera:
        frames: list[Frame] = sorted(capture.frames, key=lambda frame: frame.mid_us)
        cameras = [capture.camera(frame) for frame in frames if frame.camera == frames[0].camera]
    else:
        cameras = list(capture.cameras.values())
    if len(cameras) < 2:
        raise ConfigError(
            f"--path interpolate: {capture.path} has one camera, expected two or more; take orbit "
            "or swing, or write a camera path file (docs/render.md)."
        )
    return through(np.linspace(0, 1, len(cameras)).tolist(), cameras)


def read_camera_path(path: Path | str) -> CameraPath:
    """The path in a JSON file, whose format is said at the top of this module.

    Raises:
        DataError: missing, no camera path, or a field that is wrong, which is named.
    """
    path = Path(path)
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != "evsplat-camera-path":
        raise DataError(
            f"{path}: format is missing or another one, expected 'evsplat-camera-path' "
            "(docs/render.md says what such a file holds)."
        )
    if document.get("version") != 1:
        raise DataError(f"{path}: version is {document.get('version')!r}, expected 1.")
    size = [document.get(name) for name in ("width", "height")]
    if not all(isinstance(value, int) and 1 <= value <= 16_384 for value in size):
        raise DataError(f"{path}: width, height are {size}, expected whole pixels, 1 to 16384.")
    keys = document.get("keys")
    if not isinstance(keys, list) or not keys or not all(isinstance(key, dict) for key in keys):
        raise DataError(f"{path}: keys is empty or no list of objects, expected one or more keys.")
    width, height = (int(value) for value in size if value is not None)
    shares = [float(_numbers(path, i, key, "at", ())) for i, key in enumerate(keys)]
    if any(not 0 <= share <= 1 for share in shares) or any(np.diff(shares) < _LEAST_STEP):
        raise DataError(
            f"{path}: at is {brief(shares)}, expected shares of the film, 0 to 1, each at least "
            f"{_LEAST_STEP:g} above the one before."
        )
    cameras = [
        Camera(width, height, _key_intrinsics(path, i, key, width, height), _key_pose(path, i, key))
        for i, key in enumerate(keys)
    ]
    return through(shares, cameras)


def camera_path_document(cameras: Sequence[Camera]) -> dict[str, Any]:
    """The JSON document of a path through cameras, at equal shares of the film.

    The size of the film's picture is the first camera's; intrinsics are scaled to it.
    """
    first = cameras[0]
    keys = []
    for share, camera in zip(np.linspace(0, 1, len(cameras)), cameras, strict=True):
        fx, fy, cx, cy = _intrinsics(camera, first).tolist()
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        pose = camera.world_to_camera.double().tolist()
        keys.append({"at": float(share), "world_to_camera": pose, "K": K})
    size = {"width": first.width, "height": first.height}
    return {"format": "evsplat-camera-path", "version": 1, **size, "keys": keys}


def _key_pose(path: Path, index: int, key: dict[str, Any]) -> Float[Tensor, "4 4"]:
    if "world_to_camera" in key:
        pose = _numbers(path, index, key, "world_to_camera", (4, 4))
        turn = pose[:3, :3]
        proper = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-3 and np.linalg.det(turn) > 0
        if not proper or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise DataError(
                f"{path}: keys[{index}].world_to_camera is no rigid transform, expected a "
                "rotation, a shift and the last row 0 0 0 1."
            )
        return torch.from_numpy(pose).float()
    eye, target, up = (_numbers(path, index, key, name, (3,)) for name in ("eye", "target", "up"))
    forward = target - eye
    right = np.cross(forward, up)
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise DataError(
            f"{path}: keys[{index}]: target lies in eye or straight along up; move one of them."
        )
    rows = np.stack((right, np.cross(forward, right), forward))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rows, -rows @ eye
    return torch.from_numpy(pose).float()


def _key_intrinsics(
    path: Path, index: int, key: dict[str, Any], width: int, height: int
) -> Float[Tensor, "3 3"]:
    if "K" in key:
        K = _numbers(path, index, key, "K", (3, 3))
        if K[0, 1] or K[1, 0] or np.diag(K)[:2].min() < 1e-3 or K[2].tolist() != [0, 0, 1]:
            raise DataError(
                f"{path}: keys[{index}].K is {K.tolist()}, expected "
                "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths."
            )
        return torch.from_numpy(K).float()
    angle = float(_numbers(path, index, key, "fov_y_deg", ()))
    if not 0.01 <= angle < 180:
        raise DataError(
            f"{path}: keys[{index}].fov_y_deg is {angle:g}, expected 0.01 to 180 degrees."
        )
    focal = height / 2 / math.tan(math.radians(angle) / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _numbers(
    path: Path, index: int, key: dict[str, Any], name: str, shape: tuple[int, ...]
) -> np.ndarray:
    expected = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
    expected += f" of at most {_LARGEST:g}"
    try:
        values = np.array(key[name], dtype=np.float64)
    except KeyError:
        raise DataError(f"{path}: keys[{index}].{name} is missing, expected {expected}.") from None
    except (TypeError, ValueError, OverflowError):
        values = np.array(math.nan)
    if values.shape != shape or not (np.abs(values) <= _LARGEST).all():
        raise DataError(f"{path}: keys[{index}].{name} is {brief(key[name])}, expected {expected}.")
    return values


def _intrinsics(camera: Camera, like: Camera) -> Float[np.ndarray, "4"]:
    """Focal lengths and principal point in pixels of a picture of the size of ``like``."""
    K = camera.K.double().numpy()
    scale = np.array([like.width / camera.width, like.height / camera.height])
    return np.concatenate((np.diag(K)[:2] * scale, K[:2, 2] * scale))


def _placed(
    camera: Camera, rotation: Float[np.ndarray, "3 3"], center: Float[np.ndarray, "3"]
) -> Camera:
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ center
    return replace(camera, world_to_camera=torch.from_numpy(world_to_camera).float())
