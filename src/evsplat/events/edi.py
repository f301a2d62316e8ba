"""Event double integral: the sharp picture at any time of an exposure, in closed form.

Pan et al., "Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera" (2019). With
E(u) the change of log intensity that the events report from the start of the exposure to u, the
blurry picture is ``B = I(start) * mean over u of exp(E(u))`` (their eq. 6 and 7), so that
``I(t) = B * exp(E(t)) / mean exp(E)``. E is a staircase; its integral is taken exactly over the
events' own times, not over bins.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from evsplat.errors import DataError
from evsplat.events.maps import event_pixels
from evsplat.events.stream import EventStream
from evsplat.pictures.light import Transfer, decode, encode

ContrastThreshold = tuple[float, float]
"""C+ and C-: change of log intensity per event, both positive."""


def deblur(
    blurry_srgb: Float[Tensor, "H W 3"],
    events: EventStream,
    exposure_us: tuple[int, int],
    times_us: Sequence[int],
    contrast_threshold: ContrastThreshold,
    *,
    transfer: Transfer = "power",
) -> Float[Tensor, "T H W 3"]:
    """Sharp pictures at ``times_us`` from a blurry one, sRGB-coded in [0, 1] like it.

    ``events`` are on the camera's clock and cover the exposure and all of ``times_us``, which may
    lie outside of the exposure. They see luminance only: all three linear channels are multiplied
    by the same factor, so that the hue of a pixel stays what it was in the blurry picture. Without
    events at a pixel it stays as it is. ``exposure_us``: start and end.

    Raises:
        DataError: an exposure without length, or events outside of the picture.
    """
    height, width = blurry_srgb.shape[:2]
    gain = log_gain(events, exposure_us, times_us, contrast_threshold, height, width)
    factor = torch.from_numpy(np.exp(gain).astype(np.float32)).to(blurry_srgb.device)
    return encode(decode(blurry_srgb, transfer) * factor[..., None], transfer).clamp(0, 1)


def log_gain(
    events: EventStream,
    exposure_us: tuple[int, int],
    times_us: Sequence[int],
    contrast_threshold: ContrastThreshold,
    height: int,
    width: int,
) -> Float[np.ndarray, "T H W"]:
    """Logarithm of the sharp linear picture at each time over the blurry one."""
    start, end = exposure_us
    if end <= start:
        raise DataError(f"an exposure from {start} to {end} us has no length; give start < end.")
    pixel = event_pixels(events, height, width, "frames and events must share their pixels")
    steps = np.where(events.p > 0, contrast_threshold[0], -contrast_threshold[1])
    first, last = np.searchsorted(events.t, exposure_us)
    inside = slice(first, max(first, last))
    mean = _mean_brightness(
        pixel[inside], events.t[inside], steps[inside], exposure_us, height * width
    )
    gains = np.empty((len(times_us), height * width))
    for gain, time in zip(gains, times_us, strict=True):
        # Times before the start go back through the events between.
        index = int(np.searchsorted(events.t, time))
        between, sign = (slice(first, index), 1) if index >= first else (slice(index, first), -1)
        change = np.bincount(pixel[between], steps[between], height * width)
        gain[:] = sign * change - np.log(mean)
    return gains.reshape(len(times_us), height, width)


def _mean_brightness(
    pixel: Int64[np.ndarray, "N"],
    t: Int64[np.ndarray, "N"],
    steps: Float[np.ndarray, "N"],
    exposure_us: tuple[int, int],
    pixels: int,
) -> Float[np.ndarray, "P"]:
    """Mean over the exposure of exp(E), per pixel."""
    start, end = exposure_us
    order = np.argsort(pixel, kind="stable")
    pixel, t, steps = pixel[order], t[order], steps[order]
    after = _running_sum(pixel, steps)
    # Each event lifts the staircase for what is left of the exposure.
    lift = (np.exp(after) - np.exp(after - steps)) * ((end - t) / (end - start))
    # Rounding must not make the mean of something positive vanish.
    return np.maximum(1.0 + np.bincount(pixel, lift, pixels), np.finfo(np.float64).tiny)


def _running_sum(
    group: Int64[np.ndarray, "N"], values: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """Cumulative sum that starts anew with each run of equal ``group``."""
    if len(values) == 0:
        return values
    total = np.cumsum(values)
    starts = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
    before = (total - values)[starts]
    return total - np.repeat(before, np.diff(np.r_[starts, len(values)]))
