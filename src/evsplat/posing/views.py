"""Cameras of T pictures, stacked, in float64."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera

_NEAREST_M = 0.2
"""Points nearer than this are projected as if they were this far: a step may go astray."""


@dataclass(frozen=True)
class Views:
    """Pinhole cameras of T pictures."""

    K: Float[Tensor, "T 3 3"]
    world_to_camera: Float[Tensor, "T 4 4"]

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> "Views":
        """Of the camera of each picture."""
        return cls(
            torch.stack([camera.K.double() for camera in cameras]),
            torch.stack([camera.world_to_camera.double() for camera in cameras]),
        )

    @property
    def rotation(self) -> Float[Tensor, "T 3 3"]:
        """World axes to camera axes."""
        return self.world_to_camera[:, :3, :3]

    @property
    def focal_px(self) -> Float[Tensor, "T"]:
        """Mean focal length."""
        return (self.K[:, 0, 0] + self.K[:, 1, 1]) / 2

    def with_focal(self, focal_px: float) -> "Views":
        """The same with another focal length, pixels being square."""
        K = self.K.clone()
        K[:, 0, 0] = K[:, 1, 1] = focal_px
        return replace(self, K=K)

    def project(
        self, points: Float[Tensor, "T L 3"]
    ) -> tuple[Float[Tensor, "T L 2"], Float[Tensor, "T L 2 3"]]:
        """Pixels of world points and their derivatives by the points."""
        turn, shift = self.rotation, self.world_to_camera[:, None, :3, 3]
        seen = points @ turn.mT + shift
        depth = seen[..., 2:].clamp_min(_NEAREST_M)
        focal = torch.stack((self.K[:, 0, 0], self.K[:, 1, 1]), -1)[:, None]
        middle = self.K[:, None, :2, 2]
        slope = focal / depth
        pixels = seen[..., :2] * slope + middle
        by_camera = torch.zeros(*points.shape[:2], 2, 3, dtype=points.dtype)
        by_camera[..., 0, 0], by_camera[..., 1, 1] = slope.unbind(-1)
        by_camera[..., 2] = -seen[..., :2] * slope / depth
        return pixels, by_camera @ turn[:, None]

    def lift(self, pixels: Float[Tensor, "T 2"], depth: Float[Tensor, "T"]) -> Float[Tensor, "T 3"]:
        """World points that project to ``pixels`` at ``depth`` metres along the axis."""
        homogeneous = torch.cat((pixels, torch.ones_like(depth)[:, None]), -1)
        rays = torch.linalg.solve(self.K, homogeneous[..., None])[..., 0]
        from_camera = rays * depth[:, None] - self.world_to_camera[:, :3, 3]
        return (self.rotation.mT @ from_camera[..., None])[..., 0]
