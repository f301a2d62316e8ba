"""Maps of what frames change by and of what events add up to meanwhile."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.events.maps import event_pixels

_MOST_EVENTS = 200_000
"""About a pair; of more a part is taken."""
_LARGEST_CHANGE, _MOST_THRESHOLDS = 1.5, 6.0
"""What counts of a pixel at most: few that change most would decide alone."""

Map = Float32[np.ndarray, "P h w"]


def change_map(pair: FramePair) -> Float32[np.ndarray, "H W"]:
    """Change of log luminance without the camera's own; 0 where pixels are dark or clipped."""
    change = np.where(pair.usable, pair.change - pair.camera_change, 0.0)
    return np.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE).astype(np.float32)


def told_maps(
    pair: FramePair,
    events: EventSource,
    lags_us: Float[np.ndarray, "L"],
    size: tuple[int, int],
    step: int,
) -> Float32[np.ndarray, "L h w"]:
    """Sums of polarities at each lag, of what may be read: means over squares of ``step`` pixels.

    ``size`` is width and height of the sensor. What is left at the right and below is cut off.
    """
    (start, end), (low, high) = pair.span_us, pair.recorded_us
    first = max(start + math.floor(lags_us[0]), low)
    near = events.between(first, max(first, min(end + math.ceil(lags_us[-1]), high)))
    near = near.take(slice(None, None, max(1, len(near) // _MOST_EVENTS)))
    width, height = (side // step for side in size)
    small = replace(near, x=near.x // step, y=near.y // step)
    small = small.take((small.x < width) & (small.y < height))
    pixel = event_pixels(small, height, width)
    maps = np.empty((len(lags_us), height, width), np.float32)
    for one, lag in zip(maps, lags_us, strict=True):
        weights = pair.weights(small.t - lag) * small.p
        one[:] = np.bincount(pixel, weights, height * width).reshape(height, width) / step**2
    return np.clip(maps, -_MOST_THRESHOLDS, _MOST_THRESHOLDS)


def blurred(maps: Map, sigma: float) -> Map:
    """Each map blurred by a Gaussian of ``sigma`` pixels; beyond its edges nothing changes."""
    return gaussian_filter(maps, (0, sigma, sigma), mode="constant")
