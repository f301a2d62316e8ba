"""A camera that follows the person: aimed at the smoothed pelvis, the whole body in the picture."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.camera import Camera
from evsplat.spread import evenly_spread

Turn = Callable[[float], float]
"""Angle around the person, radians, at a share of the film."""

_SMOOTHED_S = 0.25
"""Standard deviation of the pelvis's smoothing: the camera does not shake with every step."""
_RATE_HZ = 60.0
_MARGIN = 1.08
"""Of what the person takes of the picture's height or width."""
_MOST_TIMES = 48
"""Times at which the body is measured."""


def whole_turn(share: float) -> float:
    """Once around."""
    return 2 * math.pi * share


def to_both_sides(share: float, degrees: float = 25.0) -> float:
    """To both sides and back: as far as one camera's recording bears."""
    return math.radians(degrees) * math.sin(2 * math.pi * share)


def straight(share: float) -> float:
    """From where the recording camera stands."""
    return 0.0


def smoothed_pelvis(track: BodyTrack, times_us: Sequence[int]) -> Float[np.ndarray, "T 3"]:
    """The root joint's place at times, metres in the world, without what is quicker than a step."""
    first, last = min(times_us), max(times_us)
    count = max(2, 1 + round((last - first) * 1e-6 * _RATE_HZ))
    even = np.linspace(first, last, count)
    places = track.at(np.rint(even).astype(np.int64).tolist())[1] + track.body.rest_joints[0]
    rate_hz = (count - 1) / max((last - first) * 1e-6, 1 / _RATE_HZ)
    smooth = gaussian_filter1d(
        places.double().cpu().numpy(), _SMOOTHED_S * rate_hz, axis=0, mode="nearest"
    )
    return np.stack([np.interp(times_us, even, smooth[:, axis]) for axis in range(3)], 1)


def follow(
    start: Camera,
    track: BodyTrack,
    times_us: Sequence[int],
    up: Float[torch.Tensor, "3"],
    turn: Turn,
) -> list[Camera]:
    """Cameras that look at the person at every time, whose whole body each of them shows.

    They stand in the direction from which ``start`` saw the middle of the motion, turned about
    ``up`` by ``turn``, at one distance: the least that shows all, or that of ``start`` if larger.
    """
    targets = smoothed_pelvis(track, times_us)
    axis = up.double().cpu().numpy()
    away = start.center().double().cpu().numpy() - (targets.max(0) + targets.min(0)) / 2
    distance = max(_showing_all(start, track, times_us, targets), float(np.linalg.norm(away)))
    away *= distance / max(float(np.linalg.norm(away)), 1e-9)
    last = max(1, len(times_us) - 1)
    cameras = []
    for index, target in enumerate(targets):
        turned = Rotation.from_rotvec(turn(index / last) * axis).apply(away)
        cameras.append(aimed(start, target + turned, target, axis))
    return cameras


def in_view(camera: Camera, track: BodyTrack, times_us: Sequence[int]) -> bool:
    """Whether a camera that stands still has the whole body in its picture at all times."""
    for time in _some(times_us):
        pixels, depth = camera.project(track.vertices(time))
        inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
        if not bool((inside.all(-1) & (depth > 0)).all()):
            return False
    return True


def aimed(
    camera: Camera,
    eye: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> Camera:
    """A camera of the same picture at ``eye`` that has ``target`` in the middle, upright."""
    forward = target - eye
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):  # from straight above or below
        right = camera.world_to_camera[0, :3].double().cpu().numpy()
    rows = np.stack((right, np.cross(forward, right), forward))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rows, -rows @ eye
    K = camera.K.clone()
    K[0, 2], K[1, 2] = camera.width / 2, camera.height / 2
    return replace(camera, K=K, world_to_camera=torch.from_numpy(pose).float())


def _showing_all(
    camera: Camera, track: BodyTrack, times_us: Sequence[int], targets: Float[np.ndarray, "T 3"]
) -> float:
    """Distance at which a ball around the target, with the body in it at all times, is in view."""
    radius = 0.0
    for time in _some(times_us):
        target = targets[list(times_us).index(time)]
        vertices = track.vertices(time).double().cpu().numpy()
        radius = max(radius, float(np.linalg.norm(vertices - target, axis=1).max()))
    K = camera.K.double().cpu().numpy()
    half = min(camera.width / 2 / K[0, 0], camera.height / 2 / K[1, 1])
    return _MARGIN * radius / math.sin(math.atan(half))


def _some(times_us: Sequence[int]) -> list[int]:
    """Times spread evenly over all, the first and the last among them."""
    return evenly_spread(sorted(set(times_us)), _MOST_TIMES)
