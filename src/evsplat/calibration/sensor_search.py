"""How the events of another sensor lie over pictures, roughly: searched through all places.

Maps of what events add up to are laid over maps of what frames change by: in each of eight ways, by
a ladder of scales and turns, at all shifts, and at all lags of the clock.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex64, Float, Float32
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.sparse import csr_array

from evsplat.calibration.change_maps import Map, blurred
from evsplat.calibration.ways import WAYS, turned

SIDE = 48
"""Pixels along the longer side of the frames' maps, about."""
_SCALES = np.exp(np.arange(-7, 8) * 0.08)
"""Beside that at which the sensor sees as much as the pictures: 0.57 to 1.75."""
_ANGLES = np.radians((-7.5, -2.5, 2.5, 7.5))
_BLUR = 1.0
_REACH = 0.35
"""Shifts up to this share of the longer side are tried."""
_LEAST_SEEN = 0.5
"""Share of what changes in the pictures, and of what events tell, that lies in both views."""

Affine = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Guess:
    """Roughly how events lie over the pictures."""

    score: float
    """Correlation of what lies in both views; negative where events say darker of brighter."""
    lag: int
    """Index of the lag."""
    way: str
    """One of `WAYS`."""
    affine: Affine
    """From (x, y, 1) of an event to the pictures, each from the middle of their maps."""


def search(frames: Map, told: Float32[np.ndarray, "L P h w"], groups: int) -> list[list[Guess]]:
    """Guesses by all pairs, and by each of so many interleaved groups of them, the best first.

    Each list has the best shift and lag of every way, scale, turn and sign. ``told`` is of the same
    pairs at each lag, in the sensor's own pixels.
    """
    parts = [slice(group, None, groups) for group in range(groups)]
    pictures = _Pictures.of(frames, parts)
    lags, count, height, width = told.shape
    fits = frames.shape[2] / width, frames.shape[1] / height
    alike = math.sqrt(fits[0] * fits[1])
    fine = blurred(told.reshape(-1, height, width), _BLUR / alike).reshape(lags * count, -1).T
    found: list[list[Guess]] = [[] for _ in range(groups + 1)]
    for scale in alike * _SCALES:
        for angle in _ANGLES:
            cosine, sine = scale * math.cos(angle), scale * math.sin(angle)
            turn = np.array([[cosine, -sine], [sine, cosine]])
            laying = _laying(turn, (height, width), pictures.side)
            square = pictures.side, pictures.side
            laid = (laying @ fine).T.reshape(lags, count, *square)
            view = np.minimum(laying.sum(1).reshape(square) * scale**2, 1).astype(np.float32)
            scores = pictures.scores(laid, view, parts)
            for guesses, score in zip(found, scores, strict=True):
                guesses.extend(pictures.guesses(score, turn))
    return [sorted(one, key=lambda guess: -abs(guess.score)) for one in found]


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Transforms of the frames' maps on squares with room for shifts, as seen in each way."""

    side: int
    reach: int
    middle: Float[np.ndarray, "2"]
    """Of the frames' maps, (x, y) on the squares."""
    changes: Complex64[np.ndarray, "P W k k"]
    squares: Complex64[np.ndarray, "G W k k"]
    """Of what changed, squared, in each group of pairs."""
    views: Complex64[np.ndarray, "W k k"]
    """Of where the pictures are."""
    energy: Float[np.ndarray, "G"]

    @classmethod
    def of(cls, frames: Map, parts: Sequence[slice]) -> "_Pictures":
        height, width = frames.shape[1:]
        reach = math.ceil(_REACH * max(height, width))
        side = next_fast_len(max(height, width) + 2 * reach + 1, real=True)
        top, left = (side - height) // 2, (side - width) // 2
        inside = np.s_[..., top : top + height, left : left + width]
        maps, view = np.zeros((len(frames), side, side), np.float32), np.zeros((side, side))
        maps[inside], view[inside] = blurred(frames, _BLUR), 1

        def seen(maps: np.ndarray) -> np.ndarray:
            ways = [turned(maps, way) for way in WAYS.values()]
            return np.conj(rfft2(np.stack(ways, axis=-3).astype(np.float32)))

        powers = np.stack([np.square(maps[part]).sum(0) for part in parts])
        middle = np.array([left + (width - 1) / 2, top + (height - 1) / 2])
        return cls(side, reach, middle, seen(maps), seen(powers), seen(view), powers.sum((1, 2)))

    def scores(
        self,
        laid: Float32[np.ndarray, "L P k k"],
        view: Float32[np.ndarray, "k k"],
        parts: Sequence[slice],
    ) -> Iterator[Float[np.ndarray, "W L s s"]]:
        """Correlations at all shifts, rows first, by all pairs and by each group of them.

        0 where too little lies in both views. ``view`` is where the sensor is.
        """
        shifts = np.arange(-self.reach, self.reach + 1)
        at = np.ix_(shifts, shifts)

        def summed(spectra: np.ndarray) -> np.ndarray:
            return irfft2(spectra, (self.side, self.side))[..., at[0], at[1]]

        events = rfft2(laid)
        products = [
            summed(np.einsum("pwyx,lpyx->wlyx", self.changes[part], events[:, part]))
            for part in parts
        ]
        changes = summed(self.squares * rfft2(view))[:, :, None]
        powers = np.stack([np.square(laid[:, part]).sum(1) for part in parts])
        told = summed(self.views[:, None] * rfft2(powers)[:, None])
        whole = powers.sum((-2, -1))[:, None, :, None, None]
        for groups in ([*range(len(parts))], *([group] for group in range(len(parts)))):
            product = sum(products[group] for group in groups)
            change, power = changes[groups].sum(0), told[groups].sum(0)
            enough = (change > _LEAST_SEEN * self.energy[groups].sum()) & (
                power > _LEAST_SEEN * whole[groups].sum(0)
            )
            size = np.sqrt(np.where(enough, change * power, 1))
            yield np.where(enough, product / size, 0)

    def guesses(
        self, score: Float[np.ndarray, "W L s s"], turn: Float[np.ndarray, "2 2"]
    ) -> Iterator[Guess]:
        """The highest and the lowest correlation of each way."""
        for (name, way), of_way in zip(WAYS.items(), score, strict=True):
            for best in (np.argmax(of_way), np.argmin(of_way)):
                lag, y, x = np.unravel_index(int(best), of_way.shape)
                shift = np.array([x, y]) - self.reach
                affine = np.eye(3)
                affine[:2, :2] = way @ turn
                # events that lie so far right and down of the pictures go back by as much
                affine[:2, 2] = (self.side - 1) / 2 - self.middle - way @ shift
                yield Guess(float(of_way[lag, y, x]), int(lag), name, affine)


def _laying(turn: Float[np.ndarray, "2 2"], sensor: tuple[int, int], side: int) -> csr_array:
    """Lays maps of a sensor about the middle of squares; each pixel falls to the four about it."""
    height, width = sensor
    y, x = np.mgrid[:height, :width]
    points = np.stack([x - (width - 1) / 2, y - (height - 1) / 2]).reshape(2, -1)
    at = turn @ points + (side - 1) / 2
    low = np.floor(at).astype(int)
    rows, columns, weights = [], [], []
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        pixel = low + np.array(corner)[:, None]
        weight = (1 - np.abs(at - pixel)).prod(0)
        inside = ((pixel >= 0) & (pixel < side)).all(0)
        rows.append((pixel[1] * side + pixel[0])[inside])
        columns.append(np.flatnonzero(inside))
        weights.append(weight[inside].astype(np.float32))
    shared = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(shared, shape=(side * side, height * width))
