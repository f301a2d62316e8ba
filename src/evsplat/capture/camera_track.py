"""Where a camera is at any time: a smooth way through the poses of its frames."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture.metadata import Frame


class CameraTrack:
    """A camera whose poses are known at the mid-exposures of its frames, at any time.

    Optical centre: a cubic spline. Orientation in the world: scipy's RotationSpline. With two poses
    both go evenly from one to the other. Before the first middle and behind the last the camera
    goes on as it came, mirrored in place and time, but no farther than these exposures last: beyond
    it stands.
    """

    def __init__(self, camera: Camera, frames: Sequence[Frame]) -> None:
        """``frames``: those of ``camera``, whose own pose is that of frames without one."""
        ordered = sorted(frames, key=lambda frame: frame.mid_us)
        self._poses: dict[int, Tensor] = {}
        for frame in ordered:
            own = frame.world_to_camera
            # Exposures may lie within each other and have one middle: the first one's pose holds.
            self._poses.setdefault(frame.mid_us, camera.world_to_camera if own is None else own)
        poses = list(self._poses.values())
        self.moves = any(not torch.equal(pose, poses[0]) for pose in poses)
        """False where the camera stands still."""
        given = any(frame.world_to_camera is not None for frame in frames)
        self.camera = replace(camera, world_to_camera=poses[0]) if given else camera
        """At its first frame."""
        if self.moves:
            self._range_us = ordered[0].exposure_us[0], ordered[-1].exposure_us[1]

    def at(self, times_us: Sequence[int]) -> tuple[Camera, ...]:
        """The camera at each time; one object for all where it does not move.

        At a frame's middle it has that frame's pose as it is given.
        """
        if not self.moves:
            return (self.camera,) * len(times_us)
        found = self._between(np.clip(np.asarray(times_us, np.int64), *self._range_us))
        poses = [self._poses.get(time, pose) for time, pose in zip(times_us, found, strict=True)]
        return tuple(replace(self.camera, world_to_camera=pose) for pose in poses)

    def _between(self, times_us: np.ndarray) -> Float[Tensor, "T 4 4"]:
        seconds, centers, turns = self._way
        at = (times_us - next(iter(self._poses))) * 1e-6
        within = np.clip(at, seconds[0], seconds[-1])
        # Of what lies between the middles both are the same time.
        mirrored = np.clip(2 * within - at, seconds[0], seconds[-1])
        center = 2 * centers(within) - centers(mirrored)
        turn = turns(within) * turns(mirrored).inv() * turns(within)
        to_camera = turn.inv().as_matrix()
        poses = np.tile(np.eye(4), (len(times_us), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = to_camera, -(to_camera @ center[..., None])[..., 0]
        return torch.from_numpy(poses).float()

    @cached_property
    def _way(self) -> tuple[np.ndarray, CubicSpline, RotationSpline]:
        """Seconds since the first middle; centres and camera-to-world rotations by them."""
        times = np.array(list(self._poses), np.int64)
        seconds = (times - times[0]) * 1e-6
        poses = torch.stack(list(self._poses.values())).double().numpy()
        to_world = poses[:, :3, :3].transpose(0, 2, 1)
        centers = -(to_world @ poses[:, :3, 3:])[..., 0]
        turns = RotationSpline(seconds, Rotation.from_matrix(to_world))
        return seconds, CubicSpline(seconds, centers), turns
