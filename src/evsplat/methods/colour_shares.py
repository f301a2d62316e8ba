"""How much of a part of a picture looks like each of its pixels: blurred histograms of colours."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

_LEVELS, _BLUR = 20, 1.0
"""Levels of each channel, and how far a colour counts beside its own."""
_BRIGHT = 0.995
"""Quantile of the picture's channels that is the highest level."""


class ColourShares:
    """Of one picture."""

    def __init__(self, picture: Float[np.ndarray, "H W 3"]) -> None:
        scaled = picture / max(float(np.quantile(picture, _BRIGHT)), 1e-3)
        levels = np.clip(scaled * _LEVELS, 0, _LEVELS - 1).astype(int)
        self._levels = tuple(np.moveaxis(levels, -1, 0))

    def of(self, weights: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
        """Share of the weights, all of which may be 0, that has about each pixel's colour."""
        histogram = np.zeros((_LEVELS,) * 3)
        np.add.at(histogram, self._levels, weights)
        blurred = gaussian_filter(histogram, _BLUR, mode="constant")
        shares: Float[np.ndarray, "H W"] = blurred[self._levels] / max(float(blurred.sum()), 1e-9)
        return shares
