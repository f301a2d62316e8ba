"""Maps of what frames change by and of what events add up to meanwhile."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter

from evsplat.calibration.brightness import HISTORY_US, EventSource, FramePair, level_steps
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


class Told:
    """What events add up to about a pair of frames, in the sensor's own pixels, at any lag."""

    def __init__(
        self,
        pair: FramePair,
        events: EventSource,
        most_lag_us: float,
        size: tuple[int, int],
        step: int,
    ) -> None:
        """Read what may be, for lags up to ``most_lag_us`` either way.

        ``size`` is width and height of the sensor, whose maps are means over squares of ``step``
        pixels. What is left at the right and below is cut off.
        """
        (start, end), (low, high) = pair.span_us, pair.recorded_us
        most = math.ceil(most_lag_us)
        first = max(start - most - HISTORY_US, low)
        near = events.between(first, max(first, min(end + most, high)))
        self._shape = size[1] // step, size[0] // step
        near = near.take((near.y // step < self._shape[0]) & (near.x // step < self._shape[1]))
        lifts = level_steps(event_pixels(near, size[1], size[0]), near.p > 0)
        some = slice(None, None, max(1, len(near) // _MOST_EVENTS))
        near, self._lifts = near.take(some), lifts[some] / step**2
        small = replace(near, x=near.x // step, y=near.y // step)
        self._t, self._pixel = near.t, event_pixels(small, *self._shape)
        self._pair = pair

    def maps(self, lags_us: Float[np.ndarray, "L"]) -> Float32[np.ndarray, "L h w"]:
        """Sums of how far events lift the most likely levels (`level_steps`), in thresholds."""
        maps = np.empty((len(lags_us), *self._shape), np.float32)
        for one, lag in zip(maps, lags_us, strict=True):
            weights = self._pair.weights(self._t - lag) * self._lifts
            one[:] = np.bincount(self._pixel, weights, one.size).reshape(self._shape)
        return np.clip(maps, -_MOST_THRESHOLDS, _MOST_THRESHOLDS)


def blurred(maps: Map, sigma: float) -> Map:
    """Each map blurred by a Gaussian of ``sigma`` pixels; beyond its edges nothing changes."""
    return gaussian_filter(maps, (0, sigma, sigma), mode="constant")
