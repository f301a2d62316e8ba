"""Pictures and maps made smaller by means over squares of pixels."""

import numpy as np
from jaxtyping import Float


def square_means(
    maps: np.ndarray, step: int, kind: type[np.floating] = np.float32
) -> Float[np.ndarray, "*maps h w"]:
    """Means of (..., H, W) maps over squares of ``step`` pixels, summed and given as ``kind``.

    What is left at the right and below is cut off.
    """
    height, width = maps.shape[-2] // step, maps.shape[-1] // step
    cut = maps[..., : height * step, : width * step]
    squares = cut.reshape(*maps.shape[:-2], height, step, width, step)
    return squares.mean((-3, -1), dtype=kind)
