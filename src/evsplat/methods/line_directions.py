"""Edges of a picture, and which of them run along a direction of the world."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.plane_sweep import pooled

TURNS = np.radians(np.arange(-45.0, 45.0))
"""Of walls that are tried: at right angles to each other, they are the same a quarter turn on."""
_OFF = np.radians(6.0)
"""Standard deviation of an edge's direction, radians."""
_WEAK, _STRONG = 0.15, 0.9
"""Share of a strong edge that is none, and the quantile of the picture's at which it is strong."""
_BORDER = 2
"""Pixels along the border whose gradients know nothing."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Edges of a picture."""

    picture: Float[np.ndarray, "H W 3"]
    camera: Camera
    strength: Float[np.ndarray, "H W"]
    """In [0, 1]."""
    gradient: Float[np.ndarray, "H W 2"]
    """Direction, of length 1 and of either sign, in which colours change most: x and y."""
    places: Float[np.ndarray, "H W 2"]
    """Of the pixels' middles on the plane one metre ahead of the camera, metres: x and y."""

    @staticmethod
    def of(picture: Float[np.ndarray, "H W 3"], camera: Camera) -> "Lines":
        """By the structure tensor of the three channels."""
        x, y = (
            gaussian_filter(picture, (1, 1, 0), order=order) for order in ((0, 1, 0), (1, 0, 0))
        )
        xx, yy, xy = (x * x).sum(-1), (y * y).sum(-1), (x * y).sum(-1)
        size = np.sqrt(xx + yy)
        one_way = np.hypot(xx - yy, 2 * xy) / np.maximum(xx + yy, 1e-12)
        strong = max(float(np.quantile(size * one_way, _STRONG)), 1e-4)
        strength = np.clip(size * one_way / strong - _WEAK, 0, 1)
        inner = np.zeros_like(strength)
        inner[_BORDER:-_BORDER, _BORDER:-_BORDER] = 1
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        gradient = np.stack([np.cos(angle), np.sin(angle)], -1)
        places = pixel_rays(camera) @ camera.world_to_camera[:2, :3].T
        return Lines(picture, camera, strength * inner, gradient, places.double().numpy())

    @staticmethod
    def pooled(picture: Float[Tensor, "H W 3"], camera: Camera, step: int) -> "Lines":
        """By the means of squares of ``step`` pixels."""
        means = pooled(picture, step).double().numpy()
        return Lines.of(means, camera.smaller(step, whole=False))

    def along(self, direction: Float[Tensor, "3"]) -> Float[np.ndarray, "H W"]:
        """How well each edge's direction is that of the world, 1 where it is."""
        x, y, z = (self.camera.world_to_camera[:3, :3] @ direction).tolist()
        focal = self.camera.K.diagonal()[:2].double().numpy()
        # The way of a point's picture when it moves so: towards the direction's vanishing point.
        way = (np.array([x, y]) - self.places * z) * focal
        way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
        off = np.arcsin(np.clip(np.abs((way * self.gradient).sum(-1)), 0, 1))
        return np.exp(-0.5 * np.square(off / _OFF))


def step_to(camera: Camera, side_px: int) -> int:
    """Side of the squares of which a picture has about ``side_px`` along its shorter side."""
    return max(1, round(min(camera.width, camera.height) / side_px))


def level_axes(
    camera: Camera, up: Float[Tensor, "3"], turn: float
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """To the right along a wall that ``camera`` faces but for ``turn``, radians, and into it."""
    looks = camera.world_to_camera[2, :3]
    ahead = normalize(looks - (looks @ up) * up, dim=0)
    right = torch.linalg.cross(ahead, up)
    cosine, sine = math.cos(turn), math.sin(turn)
    return cosine * right - sine * ahead, cosine * ahead + sine * right


def wall_turn(lines: Lines, up: Float[Tensor, "3"]) -> tuple[float, float]:
    """Turn of the walls about ``up``, see `level_axes`, and the mean agreement of the edges.

    Coughlan and Yuille, Manhattan World (ICCV 1999), with sums in place of a likelihood.
    """
    upright = lines.along(up)
    agreements = []
    for turn in TURNS:
        level = [lines.along(axis) for axis in level_axes(lines.camera, up, float(turn))]
        best = np.maximum(upright, np.maximum(*level))
        agreements.append(float((lines.strength * best).sum()))
    most = int(np.argmax(agreements))
    return float(TURNS[most]), agreements[most] / max(float(lines.strength.sum()), 1e-9)
