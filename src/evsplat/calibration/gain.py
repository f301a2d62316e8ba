"""The brightness that a camera itself changes from picture to picture: automatic exposure, gain
and white balance, and lamps that flicker.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from evsplat.pictures.files import to_unit_range
from evsplat.pictures.light import Transfer, decode

_DARKEST, BRIGHTEST = 0.04, 0.98
"""Coded values: blocks darker than that in the mean are mostly noise, brighter pixels clipped."""
_STEADY = 1.02
"""Factor of light between two pictures up to which a camera counts as one of fixed exposure."""
LOOKED_AT_PX = 256
"""Of larger pictures every n-th row and column is looked at."""
_BLOCKS = 16
"""Blocks along the longer side; each is a mean over its pixels, of whose noise little is left."""
_LEAST_SHARE = 0.1
"""Share of the blocks by which the brightness of a picture is told."""
_BRIGHTER = 0.05
"""Share of pictures that may be brighter than the one that others are compared with: a flash must
not make the whole recording as bright."""
_MOST_ROUNDS, _SETTLED = 30, 1e-3
"""How blocks look in the median picture, and levels of pictures beside it, are found by turns: at
most so often, until no level changes by more."""


QUARTERS = (0.25, 0.75)
"""Quantiles for `common_change`."""


class GainMeter:
    """Gathers the pictures of a camera that stands still; tells how bright each shows the scene.

    Kept are some hundred means of each picture, 3 KB.
    """

    def __init__(self) -> None:
        self._logs: list[Float[Tensor, "C B"]] = []

    def add(self, pixels: np.ndarray, transfer: Transfer) -> None:
        """The next picture, (H, W) or (H, W, 3), as stored or in [0, 1], by its camera's curve."""
        light, usable = light_in_squares(pixels, transfer, _BLOCKS)
        self._logs.append(torch.where(usable, light.log(), torch.nan).flatten(1))

    def gains(self) -> Float[np.ndarray, "N C"] | None:
        """Light of each picture and channel (of grey ones: one) against the brightest pictures.

        None where the camera's brightness is one: people who move, and their shadows, make some
        blocks brighter and others darker, but never three quarters of them by as much as turns the
        darkest picture's light into `_STEADY` times as much. Also where pictures are of several
        kinds, or a channel is too dark or clipped to tell in all of them.
        """
        if len({log.shape for log in self._logs}) != 1:
            return None
        logs = torch.stack(self._logs)
        told = logs.isfinite().float().mean(2) >= _LEAST_SHARE
        if not told.any(0).all():
            return None
        logs[~told] = torch.nan
        low, high = _changes(logs, logs).nanquantile(torch.tensor(QUARTERS), dim=2).numpy()
        changed = np.nan_to_num(common_change(low, high))
        if np.ptp(changed, axis=0).max() <= math.log(_STEADY):
            return None
        level = torch.zeros(told.shape)
        for _ in range(_MOST_ROUNDS):
            before, level = level, _changes(logs, logs - level[..., None]).nanmedian(2).values
            if float((level - before).abs().nan_to_num().max()) < _SETTLED:
                break
        return gains_of_levels(level.double().numpy(), told.numpy())


def light_in_squares(
    pixels: np.ndarray, transfer: Transfer, most: int
) -> tuple[Float[Tensor, "C h w"], Bool[Tensor, "C h w"]]:
    """Mean light of each square of a picture, at most so many along its longer side.

    With it, whether the square is neither dark nor clipped anywhere. ``pixels`` are (H, W) or
    (H, W, 3), as stored or in [0, 1]; of large pictures every n-th row and column is looked at.
    """
    step = math.ceil(max(pixels.shape[:2]) / LOOKED_AT_PX)
    pixels = np.ascontiguousarray(pixels[::step, ::step])
    coded = to_unit_range(pixels.astype(np.float32) if pixels.dtype.kind in "fb" else pixels)
    channels = coded[None] if coded.ndim == 2 else coded.movedim(-1, 0)
    side = math.ceil(max(channels.shape[1:]) / most)
    usable = (avg_pool2d(channels, side) > _DARKEST) & (max_pool2d(channels, side) < BRIGHTEST)
    return avg_pool2d(decode(channels, transfer), side), usable


def gains_of_levels(
    levels: Float[np.ndarray, "N C"], told: Bool[np.ndarray, "N C"]
) -> Float[np.ndarray, "N C"]:
    """Gains against the brightest pictures of logarithms of light; between those ``told``."""
    order = np.arange(len(levels))
    levels = np.stack(
        [
            np.interp(order, order[known], channel[known])
            for channel, known in zip(levels.T, told.T, strict=True)
        ],
        axis=1,
    )
    brightest = np.quantile(levels, 1 - _BRIGHTER, axis=0, method="lower")
    gains: Float[np.ndarray, "N C"] = np.exp(levels - brightest)
    return gains


def common_change(
    low: Float[np.ndarray, "*shape"], high: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """What three quarters of the changes of a picture are at least, brighter or darker; else 0.

    ``low`` and ``high`` are the changes' `QUARTERS`. Somebody who moves, however large, makes some
    places brighter and others darker.
    """
    change: Float[np.ndarray, "*shape"] = np.maximum(low, 0.0) + np.minimum(high, 0.0)
    return change


def _changes(logs: Float[Tensor, "N C B"], usual: Float[Tensor, "N C B"]) -> Float[Tensor, "N C B"]:
    """Blocks of each picture beside the median over ``usual`` pictures."""
    return logs - usual.nanmedian(0).values
