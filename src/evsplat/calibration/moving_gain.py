"""The brightness that a moving camera itself changes from picture to picture.

Pictures near each other in time are laid over each other, and what most of the places that both
show change by is the camera's. Parallax and the person are what places differ by beside it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import avg_pool2d

from evsplat.calibration.gain import BRIGHTEST, gains_of_levels, light_in_squares
from evsplat.calibration.overlay import (
    INSIDE,
    back,
    carried,
    laid_over,
    one_after_the_other,
    unmoved,
)
from evsplat.pictures.light import Transfer

_SIDE = 48
"""Pictures are kept as means over squares, no longer than this."""
_STEADY, _STEADY_ON_THE_WAY = 0.04, 0.2
"""Change of light (logarithm) up to which a camera counts as one of fixed exposure: where it stays
about its place, and more for each half of a picture that it goes on. What stands at other distances
than the rest and is brighter or darker adds up on the way; 40 steady cameras (docs/experiments/
scene.md) were found to change by at most three quarters of it."""
_APART = (1, 2, 4, 8)
"""Pictures to the next that one is laid over."""
_BATCH = 128
_BLOCK = 4
"""Pixels along a block, whose mean of light is compared."""
_LEAST_OVERLAP = 0.3
"""Share of the blocks that both pictures show, below which a pair tells nothing."""
_MOST_SPREAD = 0.25
"""Deviation of the blocks' changes above which pictures do not lie over each other."""
_LEAST_ERROR = 1e-3
_FEWEST_TOLD = 0.9
"""Share of the pictures that hang together below which nothing is told of any."""
_ROUNDS = 10
_OUTLIER = 3.0
"""Standard errors beyond which a pair counts by its distance alone (Huber)."""


class MovingGainMeter:
    """Gathers the pictures of a camera that moves; tells how bright each shows the scene.

    Kept are up to 20 KB of each picture.
    """

    def __init__(self) -> None:
        self._light: list[Float[Tensor, "C h w"]] = []
        self._usable: list[Bool[Tensor, "C h w"]] = []

    def add(self, pixels: np.ndarray, transfer: Transfer) -> None:
        """The next picture, (H, W) or (H, W, 3), as stored or in [0, 1], by its camera's curve."""
        light, usable = light_in_squares(pixels, transfer, _SIDE)
        self._light.append(light.half())
        self._usable.append(usable)

    def gains(self) -> Float[np.ndarray, "N C"] | None:
        """Light of each picture and channel (of grey ones: one) against the brightest pictures.

        None where the camera's brightness is one, where pictures are of several kinds, and where
        too few of them lie over those before and after to tell.
        """
        if len(self._light) < 2 or len({light.shape for light in self._light}) != 1:
            return None
        light, usable = torch.stack(self._light).float(), torch.stack(self._usable)
        pairs = _pairs(light, usable)
        levels = np.zeros((len(light), light.shape[1]))
        told = np.zeros(levels.shape, bool)
        for channel, (change, error) in enumerate(zip(pairs.change.T, pairs.error.T, strict=True)):
            sure = np.isfinite(error)
            ends = pairs.first[sure], pairs.second[sure]
            told[:, channel] = _hang_together(*ends, len(light))
            levels[:, channel] = _levels(*ends, change[sure], error[sure], len(light))
        if told.mean(0).min() < _FEWEST_TOLD:
            return None
        steady = _STEADY + _STEADY_ON_THE_WAY * pairs.across
        found = gains_of_levels(levels, told)
        return found if np.ptp(np.log(found), axis=0).max() > steady else None


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pictures that were laid over each other."""

    first: Int64[np.ndarray, " P"]
    second: Int64[np.ndarray, " P"]
    change: Float[np.ndarray, "P C"]
    """What the logarithm of light grows by from the first to the second."""
    error: Float[np.ndarray, "P C"]
    """Of ``change``; infinite where a pair tells nothing."""
    across: float
    """How far the picture goes on in all, in halves of it."""


def _pairs(light: Float[Tensor, "N C h w"], usable: Bool[Tensor, "N C h w"]) -> _Pairs:
    logs = light.mean(1).clamp_min(1e-4).log()
    whole = usable.any(1) & (light.amax(1) < BRIGHTEST)
    ways, across = unmoved(len(light) - 1), 0.0
    firsts, seconds, changes, errors = [], [], [], []
    for apart in (apart for apart in _APART if apart < len(light)):
        first = torch.arange(len(light) - apart)
        if apart > 1:
            ways = one_after_the_other(ways[: len(first)], ways[apart // 2 :])
        found = []
        for start, i in zip(ways.split(_BATCH), first.split(_BATCH), strict=True):
            j = i + apart
            way = laid_over(
                torch.stack([logs[i], logs[j]], 1), torch.stack([whole[i], whole[j]], 1), start
            )
            change, error = _change(light[i], light[j], usable[i], usable[j], way)
            # What is carried is smoother, of which the logarithm is larger: both ways it is even.
            undone, other = _change(light[j], light[i], usable[j], usable[i], back(way))
            changes.append((change - undone) / 2)
            errors.append(torch.maximum(error, other))
            # Pictures farther apart are not looked for by way of one that shows nothing.
            way[errors[-1].isinf().all(1)] = unmoved(1)
            found.append(way)
        ways = torch.cat(found)
        if apart == 1:
            across = float(np.ptp(ways[:, :, 2].cumsum(0).numpy(), axis=0).max())
        firsts.append(first)
        seconds.append(first + apart)
    return _Pairs(
        torch.cat(firsts).numpy(),
        torch.cat(seconds).numpy(),
        torch.cat(changes).double().numpy(),
        torch.cat(errors).double().numpy(),
        across,
    )


def _change(
    before: Float[Tensor, "P C h w"],
    after: Float[Tensor, "P C h w"],
    usable_before: Bool[Tensor, "P C h w"],
    usable_after: Bool[Tensor, "P C h w"],
    ways: Float[Tensor, "P 2 3"],
) -> tuple[Float[Tensor, "P C"], Float[Tensor, "P C"]]:
    """Median over blocks of what the logarithm of their light changes by; its standard error."""
    both = ((carried(usable_after.float(), ways) > INSIDE) & usable_before).float()
    shared = avg_pool2d(both, _BLOCK) > 0.5
    seen_before, seen_after = (
        avg_pool2d(light * both, _BLOCK) for light in (before, carried(after, ways))
    )
    change = torch.where(shared, (seen_after / seen_before).log(), torch.nan).flatten(2)
    middle = change.nanmedian(2).values
    spread = 1.4826 * (change - middle[..., None]).abs().nanmedian(2).values
    count = shared.flatten(2).sum(2)
    error = 1.2533 * spread / count.clamp_min(1).sqrt() + _LEAST_ERROR
    tells = (count >= _LEAST_OVERLAP * change.shape[2]) & (spread <= _MOST_SPREAD)
    return middle.nan_to_num(), torch.where(tells, error, torch.inf)


def _hang_together(
    first: Int64[np.ndarray, " P"], second: Int64[np.ndarray, " P"], count: int
) -> Bool[np.ndarray, " N"]:
    """The pictures of the largest set that pairs join."""
    pairs = coo_array((np.ones(len(first)), (first, second)), (count, count))
    _, of = connected_components(pairs, directed=False)
    largest: Bool[np.ndarray, " N"] = of == np.bincount(of).argmax()
    return largest


def _levels(
    first: Int64[np.ndarray, " P"],
    second: Int64[np.ndarray, " P"],
    change: Float[np.ndarray, " P"],
    error: Float[np.ndarray, " P"],
    count: int,
) -> Float[np.ndarray, " N"]:
    """The pictures' levels whose differences are what pairs change by (Huber's loss)."""
    levels, off = np.zeros(count), np.zeros(len(first))
    for _ in range(_ROUNDS):
        weight = 1 / (error**2 * np.maximum(1, off / _OUTLIER))
        system = np.zeros((_APART[-1] + 1, count))  # upper diagonals, as of `solveh_banded`
        system[-1] = np.bincount(first, weight, count) + np.bincount(second, weight, count) + 1.0
        np.add.at(system, (_APART[-1] - (second - first), second), -weight)
        pull = weight * change
        right = np.bincount(second, pull, count) - np.bincount(first, pull, count)
        levels = solveh_banded(system, right)
        off = np.abs(levels[second] - levels[first] - change) / error
    return levels
