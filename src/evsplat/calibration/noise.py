"""Events that nothing in the scene has caused: background activity and hot pixels."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from scipy.ndimage import binary_dilation

from evsplat.events import EventStream

SUPPORT_US = 10_000
"""An event with another one at or beside its pixel within about this time is not noise."""
HOT_RATIO = 10.0
HOT_RATE_HZ = 5.0
LEAST_QUIET_SHARE = 0.05
QUIET_DISTANCE_PX = 3
"""Nothing moves at pixels that are farther than this from any that had a supported event."""
_BESIDE = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Background activity of a sensor."""

    rate_hz: float | None
    """Events per second and pixel where nothing moves; None where all of the picture moves."""
    brighter_share: float | None
    """Share of ON events among them (leak events of most sensors are all ON)."""
    hot_pixels: Int64[np.ndarray, "K 2"]
    """(x, y) of pixels that fire without cause, the most active first."""


def estimate_noise(
    chunks: Iterable[EventStream], width: int, height: int, duration_us: int
) -> NoiseEstimate:
    """Rate of unsupported events far from all supported ones, and hot pixels.

    Support is the usual background-activity test (Delbruck 2008): another event at one of the nine
    pixels around within about 10 ms. A hot pixel fires at more than 5 Hz and ten times as often as
    all but one of its eight neighbours. ``chunks`` are consecutive; events at their borders may
    lose support.
    """
    total = np.zeros(height * width, dtype=np.int64)
    supported = np.zeros(height * width, dtype=bool)
    lonely = np.zeros((2, height * width), dtype=np.int64)
    for chunk in chunks:
        pixel = chunk.y.astype(np.int64) * width + chunk.x
        total += np.bincount(pixel, minlength=height * width)
        alone = ~_has_support(chunk, width, height)
        supported[pixel[~alone]] = True
        for row, side in zip(lonely, (chunk.p > 0, chunk.p <= 0), strict=True):
            row += np.bincount(pixel[alone & side], minlength=height * width)
    seconds = max(duration_us, 1) / 1e6
    hot = _hot_pixels(total.reshape(height, width), seconds)
    moved = binary_dilation(supported.reshape(height, width), iterations=QUIET_DISTANCE_PX)
    quiet = ~moved.reshape(-1)
    quiet[hot[:, 1] * width + hot[:, 0]] = False
    if quiet.mean() < LEAST_QUIET_SHARE:
        return NoiseEstimate(None, None, hot)
    brighter, darker = lonely[:, quiet].sum(1)
    events = int(brighter + darker)
    return NoiseEstimate(
        rate_hz=events / (float(quiet.sum()) * seconds),
        brighter_share=float(brighter) / events if events else None,
        hot_pixels=hot,
    )


def _has_support(chunk: EventStream, width: int, height: int) -> np.ndarray:
    """Whether another event lies in the nine pixels around, in the same or a neighbouring slice.

    Slices of half of `SUPPORT_US`, so that the time between is at most `SUPPORT_US` and a pixel's
    own second event counts as well.
    """
    if len(chunk) == 0:
        return np.zeros(0, dtype=bool)
    slice_of = (chunk.t - chunk.t[0]) // (SUPPORT_US // 2) + 1
    # A border of one pixel keeps neighbours of different rows apart.
    row = width + 2
    page = row * (height + 2)
    key = slice_of * page + (chunk.y.astype(np.int64) + 1) * row + chunk.x + 1
    keys, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    found = count > 1
    for after in (-1, 0, 1):
        for dy, dx in _BESIDE:
            shift = after * page + dy * row + dx
            if shift > 0:
                at = np.searchsorted(keys, keys + shift)
                met = (at < len(keys)) & (keys[np.minimum(at, len(keys) - 1)] == keys + shift)
                # Support is mutual.
                found |= met
                found[at[met]] = True
    return found[inverse]


def _hot_pixels(total: Int64[np.ndarray, "H W"], seconds: float) -> Int64[np.ndarray, "K 2"]:
    height, width = total.shape
    padded = np.pad(total, 1, mode="reflect") if min(height, width) > 1 else np.pad(total, 1)
    around = [
        padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        for dy, dx in _BESIDE
        if (dy, dx) != (0, 0)
    ]
    second = np.sort(np.stack(around), axis=0)[-2]
    hot = (total > HOT_RATE_HZ * seconds) & (total > HOT_RATIO * np.maximum(second, 1))
    y, x = np.nonzero(hot)
    order = np.argsort(-total[y, x], kind="stable")
    return np.stack([x, y], axis=-1)[order].astype(np.int64)
