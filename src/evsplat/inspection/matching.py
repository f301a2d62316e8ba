"""Correlation of silhouettes with maps of what moves, over shifts and delays, and over times."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.fft import irfft2, next_fast_len, rfft2

_LEAST_CHANGE = 0.12
"""Silhouettes whose order is asked for are at least so far from equal (1 - correlation): as far as
errors of estimated poses change them. Whoever turns on the spot does not."""
_FEWEST_PAIRS = 20


def normalised(maps: Float[np.ndarray, "K h w"]) -> Float32[np.ndarray, "K h w"]:
    """Maps with mean 0 each, and norm 1 all together; a `ValueError` where each is constant."""
    centred = maps - maps.mean((1, 2), keepdims=True)
    norm = np.sqrt((centred**2).sum())
    if norm == 0:
        raise ValueError("maps without any difference between their pixels")
    return (centred / norm).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Correlations:
    """Products of maps and silhouettes over shifts and delays, apart for groups of maps.

    Entry ``[..., d, reach + y, reach + x]`` is of silhouettes moved ``y`` pixels down, ``x`` right.
    """

    products: Float[np.ndarray, "G D S S"]
    silhouettes: Float[np.ndarray, "G D"]
    """Sum of squares of the silhouettes, each less its mean."""
    maps: Float[np.ndarray, "G"]
    """Sum of squares of the maps."""

    @classmethod
    def of(
        cls,
        maps: Float32[np.ndarray, "K h w"],
        posed: Callable[[Int[np.ndarray, "K"]], Float32[np.ndarray, "K H W"]],
        row: Int[np.ndarray, "K D"],
        reach: int,
        groups: Sequence[slice],
    ) -> "Correlations":
        """Of ``maps`` with mean 0 each, and silhouettes ``posed(row[:, d])``, 0 or more.

        Silhouettes reach ``reach`` pixels further on each side.
        """
        pixels, (height, width) = maps[0].size, maps.shape[1:]
        size = [next_fast_len(side + 2 * reach, real=True) for side in (height, width)]
        spectra = rfft2(maps, size)
        # a silhouette has the picture's corner at (reach, reach), and transforms are periodic
        lags = np.arange(-reach, reach + 1) - reach
        rows, columns = (lags % size[0])[:, None], (lags % size[1])[None]
        products, squares = [], []
        for delay in range(row.shape[1]):
            silhouettes = posed(row[:, delay])
            both = spectra * rfft2(silhouettes, size).conj()
            sums = np.stack([both[group].sum(0) for group in groups])
            products.append(irfft2(sums, size)[:, rows, columns])
            norms = np.einsum("khw,khw->k", silhouettes, silhouettes)
            # one that reaches far beyond the picture has no less than nothing
            norms = np.maximum(norms - silhouettes.sum((1, 2)) ** 2 / pixels, 0)
            squares.append([norms[group].sum() for group in groups])
        return cls(
            np.stack(products, axis=1),
            np.array(squares).T,
            np.array([float((maps[group] ** 2).sum()) for group in groups]),
        )

    @property
    def overall(self) -> Float[np.ndarray, "D S S"]:
        """Correlation over all maps."""
        norm = np.sqrt(self.silhouettes.sum(0) * self.maps.sum())
        return self.products.sum(0) / np.maximum(norm, 1e-9)[:, None, None]

    @property
    def grouped(self) -> Float[np.ndarray, "G D S S"]:
        """Correlation over the maps of each group."""
        norm = np.sqrt(self.silhouettes * self.maps[:, None])
        return self.products / np.maximum(norm, 1e-9)[..., None, None]


@dataclass(frozen=True)
class OwnTimes:
    """How much better than those of other times each map's own silhouette fits it."""

    order: float
    """Share of the pairs (map, time) in which it does: 0.5 by chance."""
    follows: float
    """By how much, over how far silhouettes of the two times are from equal: 0 by chance, and the
    mean correlation where maps are silhouettes and noise."""

    @classmethod
    def of(
        cls,
        maps: Float[np.ndarray, "K h w"],
        posed: Float[np.ndarray, "K h w"],
        far: Bool[np.ndarray, "K K"],
    ) -> "OwnTimes | None":
        """Of the pairs ``far``, which holds each one's reverse as well.

        Silhouettes that fit all maps better than others do gain nothing by that. None where there
        are few pairs, or silhouettes hardly differ.
        """
        if far.sum() < _FEWEST_PAIRS:
            return None
        silhouettes = _unit(posed)
        differ = float(1 - (silhouettes @ silhouettes.T)[far].mean())
        if differ < _LEAST_CHANGE:
            return None
        fits = _unit(maps) @ silhouettes.T
        fits = fits - fits.mean(0)
        better = (np.diag(fits)[:, None] - fits)[far]
        return cls(
            float(np.mean((better > 0) + 0.5 * (better == 0))), float(better.mean()) / differ
        )


def _unit(maps: np.ndarray) -> Float32[np.ndarray, "K P"]:
    """Each map with mean 0 and norm 1, flat; a constant one is 0."""
    flat = maps.reshape(len(maps), -1).astype(np.float32)
    flat = flat - flat.mean(1, keepdims=True)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
