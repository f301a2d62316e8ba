"""Event maps: what happened in a window, per pixel."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.errors import DataError
from evsplat.events.stream import EventStream


def count_map(stream: EventStream, height: int, width: int) -> Float[Tensor, "H W"]:
    """Sum of polarities per pixel (the event map E of paper eq. 8), float32 on the CPU."""
    if len(stream) and (stream.x.max() >= width or stream.y.max() >= height):
        raise DataError(
            f"events reach pixel x={stream.x.max()}, y={stream.y.max()}, outside of a map of "
            f"{width}x{height} pixels; give the size of the sensor that recorded them."
        )
    pixel = stream.y.astype(np.int64) * width + stream.x
    counts = np.bincount(pixel, weights=stream.p, minlength=height * width)
    return torch.from_numpy(counts.reshape(height, width).astype(np.float32))
