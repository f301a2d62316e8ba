"""How much of a part of a picture looks like each of its pixels: blurred histograms of colours."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter

_LEVELS, _BLUR = 20, 1.0
"""Levels of each channel, and how far a colour counts beside its own."""
_BRIGHT = 0.995
"""Quantile of the picture's channels that is the highest level."""
_SHADED = 0.5
"""Of a share, for a colour in a shade that need not be there."""


class ColourShares:
    """Of one picture."""

    def __init__(self, picture: Float[np.ndarray, "H W 3"]) -> None:
        self._scaled = picture / max(float(np.quantile(picture, _BRIGHT)), 1e-3)
        self._levels = _levels(self._scaled)

    def of(
        self, weights: Float[np.ndarray, "H W"], shades: Sequence[float] = ()
    ) -> Float[np.ndarray, "H W"]:
        """Share of the weights, all of which may be 0, that has about each pixel's colour.

        ``shades``: what brightness in place of 1 it may have as well, for half of the share.
        """
        histogram = np.zeros((_LEVELS,) * 3)
        np.add.at(histogram, self._levels, weights)
        histogram = gaussian_filter(histogram, _BLUR, mode="constant")
        histogram /= max(float(histogram.sum()), 1e-9)
        shares: Float[np.ndarray, "H W"] = histogram[self._levels]
        for shade in shades:
            shares = np.maximum(shares, _SHADED * histogram[_levels(self._scaled / shade)])
        return shares


def _levels(scaled: Float[np.ndarray, "H W 3"]) -> tuple[Int[np.ndarray, "H W"], ...]:
    levels = np.clip(scaled * _LEVELS, 0, _LEVELS - 1).astype(int)
    return tuple(np.moveaxis(levels, -1, 0))
