"""The browser's camera and the capture's, as cameras that are drawn."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.camera import Camera

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BrowserCamera:
    """Pose and field of view of the browser's camera; OpenCV axes, metres."""

    wxyz: tuple[float, float, float, float]
    """Rotation from the camera to the world, a unit quaternion."""
    position: Vector
    fov: float
    """Vertical field of view, radians."""

    def sized(self, width: int, height: int) -> Camera:
        """The camera with so many square pixels and the principal point in the middle."""
        focal = height / (2 * math.tan(self.fov / 2))
        w, *xyz = self.wxyz
        to_world = Rotation.from_quat([*xyz, w]).as_matrix()
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3] = to_world.T
        world_to_camera[:3, 3] = -to_world.T @ np.asarray(self.position)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(width, height, K, torch.from_numpy(world_to_camera).float())


@dataclass(frozen=True)
class ViewportPart:
    """A part of the viewport, pixels from its top left corner."""

    left: float
    top: float
    width: float
    height: float


def letterboxed(camera: Camera, width: int, height: int) -> tuple[Camera, ViewportPart]:
    """A recording camera seen through a viewport: its whole picture, centred, and its box.

    The bars that the viewport shows around the picture are drawn as well.
    """
    scale = min(width / camera.width, height / camera.height)
    box = ViewportPart(
        (width - scale * camera.width) / 2,
        (height - scale * camera.height) / 2,
        scale * camera.width,
        scale * camera.height,
    )
    K = camera.K.clone()
    K[:2] *= scale
    K[0, 2] += box.left
    K[1, 2] += box.top
    return replace(camera, width=width, height=height, K=K), box


def vertical_fov(camera: Camera) -> float:
    """Angle between the middles of the upper and lower border, radians, of a centred camera."""
    return 2 * math.atan(camera.height / 2 / float(camera.K[1, 1]))


def forward(camera: Camera) -> np.ndarray:
    """Unit vector along the optical axis, in the world."""
    return camera.world_to_camera[2, :3].double().numpy()
