"""Texture pictures as the renderer takes them: linear light, halved level by level."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from evsplat.pictures.files import opened_picture

GAMMA = 2.2
"""Pictures are decoded and encoded with this power, as the rest of the project does."""


def read_rgba(path: Path) -> UInt8[np.ndarray, "H W 4"]:
    """A picture with its transparency (opaque where it has none)."""
    with opened_picture(path) as image:
        return np.array(image.convert("RGBA"))


def pyramid(
    textures: UInt8[np.ndarray, "L H W 3"], levels: int
) -> list[Float32[np.ndarray, "L h w 3"]]:
    """Linear light of the textures and of their halves, at most ``levels`` while sides are even."""
    pixels = ((np.arange(256) / 255) ** GAMMA).astype(np.float32)[textures]
    result = [np.ascontiguousarray(pixels)]
    while len(result) < levels and not any(side % 2 for side in pixels.shape[1:3]):
        count, height, width, _ = pixels.shape
        pixels = pixels.reshape(count, height // 2, 2, width // 2, 2, 3).mean((2, 4))
        result.append(np.ascontiguousarray(pixels, dtype=np.float32))
    return result
