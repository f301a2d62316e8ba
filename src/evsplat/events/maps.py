"""Event maps: what happened in a window, per pixel, as networks and losses take it.

Every map is float32 on the CPU, polarity first ON then OFF. Where a map needs a window it is a pair
of times in microseconds; left out, it reaches from the first to the last event.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from evsplat.compiled import native
from evsplat.errors import DataError
from evsplat.events.stream import EventStream

VoxelScaling = Literal["none", "standard"]
"""``standard``: entries that are not 0 get mean 0 and standard deviation 1, as E2VID wants it."""


def count_map(stream: EventStream, height: int, width: int) -> Float[Tensor, "H W"]:
    """Sum of polarities per pixel (the event map E of paper eq. 8).

    Raises:
        DataError: an event lies outside, as for all maps here.
    """
    return _sums(event_pixels(stream, height, width), stream.p, (height, width))


def polarity_counts(stream: EventStream, height: int, width: int) -> Float[Tensor, "2 H W"]:
    """Number of ON and of OFF events per pixel."""
    place = event_pixels(stream, height, width) + (stream.p < 0) * (height * width)
    return _sums(place, None, (2, height, width))


def begun_counts(
    stream: EventStream, times_us: Sequence[int], height: int, width: int, *, reach_us: int
) -> Float[Tensor, "T 2 H W"]:
    """The share of each pixel's next ON or OFF event that has come about by each time, in 0..1.

    A pixel reports a step when it is complete. Between two events of the same polarity its
    brightness went from one step to the next, which is taken to be even in time; nothing is known
    between opposite ones, or where they lie more than ``reach_us`` apart. Times ascend; events at
    one of them are the next ones, as they are for windows that begin there.
    """
    pixels = height * width
    place = event_pixels(stream, height, width)
    index = np.arange(len(stream), dtype=np.int32)
    cuts = np.searchsorted(stream.t, times_us)
    # of several values for one place NumPy keeps the last
    following = np.full((len(times_us) + 1, pixels), -1, np.int32)
    ends = [*cuts[1:], len(stream)]
    for row in range(len(times_us) - 1, -1, -1):
        following[row] = following[row + 1]
        part = slice(cuts[row], ends[row])
        following[row, place[part][::-1]] = index[part][::-1]
    last = np.full(pixels, -1, np.int32)
    shares = np.zeros((len(times_us), 2 * pixels), np.float32)
    for row, (time, start) in enumerate(zip(times_us, [0, *cuts], strict=False)):
        part = slice(start, cuts[row])
        last[place[part]] = index[part]
        between = np.flatnonzero((last >= 0) & (following[row] >= 0))
        before, after = last[between], following[row, between]
        sign, gap = stream.p[before], stream.t[after] - stream.t[before]
        known = (sign == stream.p[after]) & (gap <= reach_us)
        channel = (sign[known] < 0) * pixels
        shares[row, between[known] + channel] = (time - stream.t[before[known]]) / gap[known]
    return torch.from_numpy(shares.reshape(-1, 2, height, width))


def window_counts(
    stream: EventStream, times_us: Sequence[int], height: int, width: int, *, reach_us: int = 0
) -> Float[Tensor, "T-1 2 H W"]:
    """Number of ON and of OFF events between neighbouring times, which ascend.

    With ``reach_us`` above 0 the share of a next event that has come about by a time
    (`begun_counts`) counts before it instead of after. ``stream`` then holds the events around.
    """
    event_pixels(stream, height, width)
    if native is not None:
        maps = torch.zeros(len(times_us) - 1, 2, height, width)
        columns = (np.ascontiguousarray(v) for v in (stream.t, stream.x, stream.y, stream.p))
        native.window_counts(*columns, np.asarray(times_us, np.int64), reach_us, maps)
        return maps
    windows = zip(times_us, times_us[1:], strict=False)
    counts = [polarity_counts(stream.between(*ends), height, width) for ends in windows]
    if reach_us <= 0:
        return torch.stack(counts)
    begun = begun_counts(stream, times_us, height, width, reach_us=reach_us)
    return torch.stack(counts) + begun[1:] - begun[:-1]


def voxel_grid(
    stream: EventStream,
    height: int,
    width: int,
    bins: int,
    *,
    window_us: tuple[int, int] | None = None,
    scaling: VoxelScaling = "none",
) -> Float[Tensor, "B H W"]:
    """Polarities shared between the two nearest of ``bins`` instants, linearly in time.

    The instants divide the window evenly and include both of its ends (Zhu et al., 2019, eq. 1-2;
    the input of E2VID). The sum over bins is `count_map` of the window, by default from the first
    event to the last.

    Raises:
        ValueError: no bin, or a window that ends before it starts.
    """
    if bins < 1:
        raise ValueError(f"a voxel grid needs at least one bin, not {bins}")
    stream, start, end = _within(stream, window_us)
    place = event_pixels(stream, height, width)
    if bins == 1 or end <= start:
        grid = torch.zeros(bins, height, width)
        grid[0] = _sums(place, stream.p, (height, width))
        return _scaled(grid, scaling)
    at = (stream.t - start) * ((bins - 1) / (end - start))
    # the last instant belongs to the interval before it
    below = np.minimum(at.astype(np.int64), bins - 2)
    above = at - below
    weights = np.concatenate([stream.p * (1 - above), stream.p * above])
    first = below * (height * width) + place
    place = np.concatenate([first, first + height * width])
    return _scaled(_sums(place, weights, (bins, height, width)), scaling)


def time_surface(
    stream: EventStream, height: int, width: int, *, decay_us: float, time_us: int | None = None
) -> Float[Tensor, "2 H W"]:
    """``exp(-(time_us - t) / decay_us)`` of the last event of each polarity; 0 where none was.

    Later events than ``time_us``, by default the last one, do not count (Lagorce et al., HOTS,
    2017, with polarities apart). ON is the first map.

    Raises:
        ValueError: a decay that is not above 0.
    """
    if not decay_us > 0:
        raise ValueError(f"the decay of a time surface must be above 0 us, not {decay_us:g}")
    stream, _, now = _within(stream, None if time_us is None else (_EARLIEST, time_us))
    last = np.full(2 * height * width, -np.inf)
    # of several values for one place NumPy keeps the last
    last[event_pixels(stream, height, width) + (stream.p < 0) * (height * width)] = stream.t
    surface = np.exp((last - now) / decay_us).reshape(2, height, width)
    return torch.from_numpy(surface.astype(np.float32))


_EARLIEST = np.iinfo(np.int64).min


def _within(stream: EventStream, window_us: tuple[int, int] | None) -> tuple[EventStream, int, int]:
    """The events of a window, both ends included, and the window."""
    if window_us is None:
        return (stream, int(stream.t[0]), int(stream.t[-1])) if len(stream) else (stream, 0, 0)
    start, end = window_us
    if end < start:
        raise ValueError(f"a window from {start} to {end} us ends before it starts")
    return stream.between(start, end + 1), start, end


def event_pixels(
    stream: EventStream,
    height: int,
    width: int,
    advice: str = "give the size of the sensor that recorded them",
) -> Int64[np.ndarray, "N"]:
    """Place of each event in a flat map; a `DataError` with ``advice`` where one lies outside."""
    if len(stream) and (stream.x.max() >= width or stream.y.max() >= height):
        raise DataError(
            f"events reach pixel x={stream.x.max()}, y={stream.y.max()}, outside of a map of "
            f"{width}x{height} pixels; {advice}."
        )
    return stream.y.astype(np.int64) * width + stream.x


def _sums(
    place: Int64[np.ndarray, "N"], weights: np.ndarray | None, shape: tuple[int, ...]
) -> Float[Tensor, "..."]:
    sums = np.bincount(place, weights=weights, minlength=int(np.prod(shape)))
    return torch.from_numpy(sums.reshape(shape).astype(np.float32))


def _scaled(grid: Float[Tensor, "B H W"], scaling: VoxelScaling) -> Float[Tensor, "B H W"]:
    if scaling == "none":
        return grid
    filled = grid != 0
    if not bool(filled.any()):
        return grid
    values = grid[filled]
    spread = values.std(correction=0)
    grid[filled] = (values - values.mean()) / (spread if spread > 0 else 1.0)
    return grid
