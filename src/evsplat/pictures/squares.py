"""Pictures and maps made smaller by means over squares of pixels."""

import numpy as np
from jaxtyping import Float32


def square_means(maps: np.ndarray, step: int) -> Float32[np.ndarray, "K h w"]:
    """Means of (K, H, W) maps over squares of ``step`` pixels.

    What is left at the right and below is cut off.
    """
    count, height, width = len(maps), maps.shape[1] // step, maps.shape[2] // step
    cut = maps[:, : height * step, : width * step].astype(np.float32)
    return cut.reshape(count, height, step, width, step).mean((2, 4))
