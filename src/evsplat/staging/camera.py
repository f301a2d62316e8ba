"""The recording camera: where it is at every instant, and when its shutter is open."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from evsplat.body import axis_angle_to_matrix
from evsplat.camera import Camera
from evsplat.options.captures import CameraMotion

TARGET = (0.0, 0.0, 0.98)
"""Point that every camera looks at: the middle of a standing person, metres."""
MAIN = (0.25, -3.35, 1.35)
NOVEL = {
    "novel_left": (-1.55, -3.0, 1.5),
    "novel_right": (1.75, -2.85, 1.2),
    "novel_back": (0.35, 1.75, 1.9),
}
_FOCAL = 600 / 512
"""Focal length in picture heights of a camera as far from its target as the recording one."""
_SWAY_M, _SWAY_RAD = 0.012, np.radians(0.4)
"""Root mean square of each axis of a hand's unrest."""
_SWAY_HZ = (0.4, 0.9, 1.7, 3.1)


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0, 0, 1)) -> np.ndarray:
    """``world_to_camera`` (4, 4) of a camera at ``eye`` whose picture's middle is ``target``."""
    eye = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def make_camera(eye: ArrayLike, width: int, height: int) -> Camera:
    """A camera at ``eye`` that shows the person at about two thirds of the picture's height."""
    focal = _FOCAL * height * min(1.0, _away(eye) / _away(MAIN))
    intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    pose = torch.from_numpy(look_at(eye, TARGET)).float()
    return Camera(width, height, torch.tensor(intrinsics), pose)


def _away(eye: ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(eye, TARGET)))


class CameraPath:
    """``world_to_camera`` of the recording camera at any time."""

    def __init__(
        self,
        motion: CameraMotion,
        duration_s: float,
        *,
        orbit_deg: float = 30.0,
        seed: int = 0,
    ) -> None:
        self.motion = motion
        self.duration_s = max(duration_s, 1e-6)
        self.orbit_deg = orbit_deg
        rng = np.random.default_rng([seed, 0xCA])
        # slow waves are larger, as hands are: amplitude falls with frequency
        share = 1 / np.array(_SWAY_HZ)
        self._amplitude = rng.normal(size=(6, len(_SWAY_HZ))) * share / np.linalg.norm(share)
        self._phase = rng.uniform(0, 2 * np.pi, size=(6, len(_SWAY_HZ)))

    def at(self, times_us: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T 4 4"]:
        """The camera's pose at each time."""
        seconds = np.asarray(times_us, dtype=np.float64) * 1e-6
        if self.motion == "orbit":
            return np.stack([self._orbit(time) for time in seconds])
        still = np.tile(look_at(MAIN, TARGET), (len(seconds), 1, 1))
        return still if self.motion == "static" else self._sway(seconds) @ still

    def _orbit(self, second: float) -> np.ndarray:
        """An even arc round the vertical through the target, symmetric about the tripod's place."""
        degrees = self.orbit_deg * (second / self.duration_s - 0.5)
        turn = Rotation.from_euler("z", degrees, degrees=True)
        return look_at(TARGET + turn.apply(np.subtract(MAIN, TARGET)), TARGET)

    def _sway(self, seconds: np.ndarray) -> np.ndarray:
        """Small rigid motions of the camera in its own axes, (T, 4, 4)."""
        angle = 2 * np.pi * np.multiply.outer(seconds, _SWAY_HZ)[:, None] + self._phase
        wave = np.sqrt(2) * (self._amplitude * np.sin(angle)).sum(-1)
        motion = np.tile(np.eye(4), (len(seconds), 1, 1))
        turn = torch.from_numpy(_SWAY_RAD * wave[:, :3])
        motion[:, :3, :3] = axis_angle_to_matrix(turn).numpy()
        motion[:, :3, 3] = _SWAY_M * wave[:, 3:]
        return motion


_FEWEST = 16
"""Sub-frames of an exposure, however short."""


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """The instants of one frame period; microseconds."""

    start_us: int
    end_us: int
    """End of the exposure, which begins at ``start_us``."""
    exposure: Int64[np.ndarray, "N"]
    """Middles of equal parts of the exposure: the mean of these pictures is the blurry one."""
    after: Int64[np.ndarray, "M"]
    """Middles of equal parts of the time until the next exposure; they only make events."""

    @property
    def mid_us(self) -> int:
        """The middle of the exposure."""
        return (self.start_us + self.end_us) // 2


def frame_times(
    frames: int, fps: float, exposure_ms: float, subframe_hz: float
) -> list[FrameTimes]:
    """All instants of a recording that starts at 0."""
    starts = np.round(np.arange(frames + 1) * 1e6 / fps).astype(np.int64)
    exposure_us = min(round(exposure_ms * 1000), int(np.diff(starts).min()))
    result = []
    for start, following in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        end = start + exposure_us
        step_us = 1e6 / subframe_hz
        parts = max(int(np.ceil(exposure_us / step_us - 1e-6)), min(_FEWEST, exposure_us))
        rest = int(np.ceil((following - end) / step_us - 1e-6))
        result.append(
            FrameTimes(start, end, _middles(start, end, parts), _middles(end, following, rest))
        )
    return result


def _middles(start: int, end: int, parts: int) -> Int64[np.ndarray, "N"]:
    steps = (np.arange(parts) + 0.5) * ((end - start) / max(parts, 1))
    return start + np.floor(steps).astype(np.int64)
