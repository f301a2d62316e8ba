"""Pinhole cameras: the OpenCV convention, pixel centres at +0.5."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from evsplat.devices import send

MOST_VIEWS = 12
"""Cameras of a recording by one that moves which stand for all of them."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion: x right, y down, z forward."""

    width: int
    height: int
    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels, float32; the centre of the first pixel is (0.5, 0.5)."""
    world_to_camera: Float[Tensor, "4 4"]
    """Rigid transform of world points (metres) to the camera, float32."""

    def center(self) -> Float[Tensor, "3"]:
        """Optical centre in the world."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def to(self, device: torch.device | str) -> "Camera":
        """The same camera with its pose on ``device``; K stays where it is read, on the CPU."""
        return replace(self, world_to_camera=send(self.world_to_camera, device))

    def with_focal(self, focal_px: float) -> "Camera":
        """The same camera with another focal length, pixels being square."""
        K = self.K.clone()
        K[0, 0] = K[1, 1] = focal_px
        return replace(self, K=K)

    def smaller(self, step: int, *, whole: bool = True) -> "Camera":
        """The camera of pictures whose pixels are means over squares of ``step`` pixels.

        What fills no square at the right and below is cut off, or without ``whole`` has pixels of
        its own.
        """
        K = self.K.clone()
        K[:2] /= step
        width, height = (
            size // step if whole else -(-size // step) for size in (self.width, self.height)
        )
        return replace(self, width=width, height=height, K=K)

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of its picture resampled to another size; pixel centres stay at +0.5."""
        factors = torch.tensor([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=self.K * factors[:, None])

    def widened(self, beyond_x: int, beyond_y: int) -> "Camera":
        """The same camera with so many pixels more at the left and right, and above and below."""
        K = self.K.clone()
        K[0, 2] += beyond_x
        K[1, 2] += beyond_y
        return replace(
            self, width=self.width + 2 * beyond_x, height=self.height + 2 * beyond_y, K=K
        )

    def project(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Pixels (x, y) and depth z of world points; pixels mean nothing where z <= 0."""
        world_to_camera = self.world_to_camera.to(points)
        in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        depth = in_camera[..., 2]
        homogeneous = in_camera @ self.K.to(points).T
        return homogeneous[..., :2] / depth[..., None], depth

    def depth(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """z of world points alone, metres; negative behind the camera."""
        world_to_camera = self.world_to_camera.to(points)
        return points @ world_to_camera[2, :3] + world_to_camera[2, 3]

    def pixels(
        self, points: Float[Tensor, "*N 3"]
    ) -> tuple[Int[Tensor, "*N"], Int[Tensor, "*N"], Float[Tensor, "*N"], Bool[Tensor, "*N"]]:
        """Column and row of the pixel that shows each point, its depth, and whether one does.

        Where none does, column and row are of the nearest one along the border.
        """
        places, depth = self.project(points)
        x, y = places.floor().long().unbind(-1)
        column, row = x.clamp(0, self.width - 1), y.clamp(0, self.height - 1)
        return column, row, depth, (depth > 0) & (x == column) & (y == row)


def distinct(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras of pictures; one alone where all are the same object, as of a camera at rest."""
    first = cameras[0]
    return (first,) if all(camera is first for camera in cameras) else tuple(cameras)


def spread_over(recorded: Sequence[Camera]) -> list[Camera]:
    """At most `MOST_VIEWS` of the cameras of a recording, evenly."""
    chosen = torch.linspace(0, len(recorded) - 1, min(MOST_VIEWS, len(recorded))).round().int()
    return [recorded[index] for index in chosen.tolist()]
