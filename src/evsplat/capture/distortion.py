"""Lens distortion (OpenCV's rational model), removed while keeping the same K."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32
from scipy.ndimage import map_coordinates

_COUNTS = (4, 5, 8)
_LARGEST = 1e9
_ITERATIONS = 50
_FOLD_GRID = 256
"""Places along a side of the picture at which a fold is looked for, at most."""


def are_coefficients(values: Sequence[object]) -> bool:
    """Whether a file gives numbers that a `Distortion` takes: as many as OpenCV has, and finite."""
    numeric = all(isinstance(v, int | float) and abs(v) < _LARGEST for v in values)
    return numeric and len(values) in _COUNTS


@dataclass(frozen=True, eq=False)
class Distortion:
    """Maps between the sensor that recorded (distorted) and the pinhole camera of the same K.

    ``K`` has pixel centres at +0.5; ``coefficients`` are OpenCV's k1, k2, p1, p2, then optionally
    k3, then optionally k4, k5, k6.
    """

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]
    coefficients: tuple[float, ...]

    def distort(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of the lens for what a pinhole camera sees at ``pixels``."""
        return self._to_pixels(_distort(self._to_rays(pixels), self.coefficients))

    def undistort(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of a pinhole camera for what the lens put at ``pixels``; NaN where none is found.

        Fixed-point iteration as in OpenCV; a result that does not distort back to within 0.1
        pixel (the model folds over itself at strong distortion) is NaN.
        """
        target = self._to_rays(pixels)
        rays = target.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                radial, tangential = _radial_and_tangential(rays, self.coefficients)
                rays = (target - tangential) / radial
            found = self._to_pixels(rays)
            error = np.abs(self.distort(found) - pixels).max(axis=-1, keepdims=True)
        return np.where(error < 0.1, found, np.nan)

    def fold(self) -> tuple[float, float]:
        """Where the model folds over itself in the pinhole picture: beyond which radius, how much.

        The least distance from the principal point, pixels, at which `distort` turns what is
        beside each other around, and the share of the picture that it does so to; infinity and
        zero where it never does.
        """
        x, y = (
            np.linspace(0.5, side - 0.5, min(side, _FOLD_GRID))
            for side in (self.width, self.height)
        )
        pixels = np.stack(np.meshgrid(x, y), axis=-1)
        rays = self._to_rays(pixels)
        folded = ~(_area_factor(rays, self.coefficients) > 0)
        if not folded.any():
            return np.inf, 0.0
        radii = np.linalg.norm(pixels - self.K[:2, 2], axis=-1)
        return float(radii[folded].min()), float(folded.mean())

    def undistort_image(self, image: np.ndarray) -> Float[np.ndarray, "..."]:
        """The pinhole picture, float32, bilinear; beyond the sensor the nearest edge pixel.

        ``image`` is (H, W) or (H, W, C) in any range.
        """
        source = self.distort(self._pixel_centres()) - 0.5
        rows_columns = [source[..., 1], source[..., 0]]
        planes = np.atleast_3d(image.astype(np.float32))
        resampled = [
            map_coordinates(planes[..., c], rows_columns, order=1, mode="nearest")
            for c in range(planes.shape[2])
        ]
        return np.stack(resampled, axis=-1).reshape(image.shape)

    def event_lookup(self) -> Int32[np.ndarray, "H W 2"]:
        """Pixel (x, y) of the undistorted picture for each sensor pixel, -1 where outside."""
        found = self.undistort(self._pixel_centres())
        inside = (found >= 0).all(-1) & (found[..., 0] < self.width) & (found[..., 1] < self.height)
        return np.where(inside[..., None], np.nan_to_num(found), -1.0).astype(np.int32)

    def _pixel_centres(self) -> Float[np.ndarray, "H W 2"]:
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def _to_rays(self, pixels: np.ndarray) -> np.ndarray:
        return (pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]

    def _to_pixels(self, rays: np.ndarray) -> np.ndarray:
        return rays * self.K[[0, 1], [0, 1]] + self.K[:2, 2]


def _radial_and_tangential(
    rays: np.ndarray, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Factor on and shift of normalised coordinates (OpenCV calib3d, eq. of the pinhole model)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    tangential = np.stack(
        [
            2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    return radial[..., None], tangential


def _area_factor(
    rays: Float[np.ndarray, "*batch 2"], coefficients: tuple[float, ...]
) -> Float[np.ndarray, "*batch"]:
    """By how much a small area at each ray grows in `_distort`; negative where it is mirrored."""
    step = 1e-6
    with np.errstate(all="ignore"):
        along_x, along_y = (
            _distort(rays + shift, coefficients) - _distort(rays - shift, coefficients)
            for shift in (np.array([step, 0.0]), np.array([0.0, step]))
        )
        cross = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    return cross / (2 * step) ** 2


def _distort(rays: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    radial, tangential = _radial_and_tangential(rays, coefficients)
    return rays * radial + tangential
