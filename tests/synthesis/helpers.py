"""Pictures with motion that is known exactly."""

import numpy as np
from scipy.ndimage import gaussian_filter, shift

from evsplat.synthesis.interpolate import Picture


def texture(height: int, width: int, seed: int, finest_px: float = 1.5) -> np.ndarray:
    """Random colours with detail at all scales, as photographs have; float64 in [0.1, 0.9]."""
    noise = np.random.default_rng(seed).normal(size=(3, height, width, 3))
    soft = np.zeros((height, width, 3))
    for octave, layer in enumerate(noise):
        sigma = finest_px * 3**octave
        layer = gaussian_filter(layer, (sigma, sigma, 0), mode="wrap")
        soft += layer / layer.std()
    return 0.5 + 0.4 * np.tanh(soft / 3)


def picture(linear: np.ndarray) -> Picture:
    linear = linear.clip(0, 1).astype(np.float32)
    return Picture(linear ** np.float32(1 / 2.2), linear)


def shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """The image moved by a vector of pixels, by cubic splines."""
    return shift(image, (y, x, 0), order=3, mode="wrap")


def disc_over_texture(at_x: float, seed: int, size: int = 96, radius: float = 12) -> np.ndarray:
    """A textured disc at a place before a standing textured background, linear light."""
    background, front = texture(size, size, seed), texture(size, size, seed + 1, 2.5)
    y, x = np.mgrid[:size, :size] + 0.5
    cover = np.clip(radius - np.hypot(x - at_x, y - size / 2) + 0.5, 0, 1)[..., None]
    return (1 - cover) * background + cover * shifted(front, at_x, 0)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - truth) ** 2)))
