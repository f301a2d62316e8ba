"""Whether events lie beside the frames: shifted, turned, of another scale, or mirrored as well.

Maps of what frames change by and of what events add up to are compared at all shifts, and at the
best one it is fitted how they are turned and scaled. Nothing but the pictures is asked.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import affine_transform

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.calibration.change_maps import Map, Told, blurred, change_map
from evsplat.calibration.clock import SEARCH_US
from evsplat.events.homography import Homography
from evsplat.pictures.squares import square_means
from evsplat.spread import evenly_spread

SURE = 0.5
"""Frames and events correlate so well or better at their place, else it is not told."""
_BEYOND_DOUBT = 0.75
"""Events that correlate so well are not looked for in a mirror, where much may look alike."""
LEAST_GAIN = 0.03
"""Of the correlation at the place found, what is missing where they are given."""
LEAST_PX = 0.6
"""Pixels of the maps by which half of what moves is displaced, or more."""
_MOST_PAIRS = 16
_SIDE = 160
"""Larger pictures are compared as means over squares, on maps no longer than this."""
_REACH = 0.2
"""Shifts up to this share of the map's shorter side are tried."""
_STEPS = 4
"""Lags that are tried, to the time between two frames; every other one at first."""
_BLURS = (2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0)
"""Standard deviation in pixels for each step of the fit; the last is that of correlations told."""
_STEPS_OF_HALVES = 3
"""Of those, for halves of the recording, from where the whole of it ends."""
_FARTHEST = 0.15
"""Turns in radians, and scales beside 1, up to here are fitted."""
_AGREEING_PX = 1.0
"""Halves of the recording agree so well on where what moves belongs."""

Affine = Float[np.ndarray, "4"]
"""Scale times cosine less 1, scale times sine, and shift right and down: from the frames' pixels to
the events', about the middle of the picture."""


@dataclass(frozen=True)
class Placement:
    """Where events lie beside the frames."""

    mirrored: tuple[bool, bool]
    """Left to right and top to bottom, before all else."""
    shift_px: tuple[float, float]
    """Right and down from the frames to the events, at the picture's middle."""
    angle_deg: float
    """Clockwise from the frames to the events."""
    scale: float
    """Of the events; above 1 they are too large."""
    correlation: float
    """Of changes in frames and events, laid onto each other so."""
    as_given: float
    size_px: tuple[int, int]
    """Width and height of the frames."""
    middle_px: tuple[float, float]
    """About which events are mirrored, turned and scaled, (0, 0) at the first pixel's centre."""

    @property
    def homography(self) -> Homography:
        """(3, 3), by which `evsplat.events.moved` brings events into the pixels of the frames."""
        (x, y), (right, down) = self.middle_px, self.shift_px
        turn = self.scale * np.exp(1j * math.radians(self.angle_deg))
        rows = [[turn.real, -turn.imag, right], [turn.imag, turn.real, down], [0, 0, 1]]
        signs = [-1.0 if is_so else 1.0 for is_so in self.mirrored]
        to_middle = np.array([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]])
        from_middle = np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])
        # events are mirrored in their own pixels, before what is fitted
        back = np.linalg.inv(np.array(rows)) @ np.diag([*signs, 1.0])
        matrix: Homography = from_middle @ back @ to_middle
        return matrix

    def __str__(self) -> str:
        """Such as "6.0 px to the right and turned by 2.0 degrees clockwise"."""
        (right, down), words = self.shift_px, []
        sides = ("left to right", "top to bottom")
        flips = [side for side, is_so in zip(sides, self.mirrored, strict=True) if is_so]
        if flips:
            words.append("mirrored " + " and ".join(flips))
        for px, ways in ((right, ("right", "left")), (down, ("down", "up"))):
            if abs(px) >= 0.5:
                words.append(f"{abs(px):.1f} px {'to the ' * (ways[0] == 'right')}{ways[px < 0]}")
        if abs(self.angle_deg) >= 0.3:
            way = "clockwise" if self.angle_deg > 0 else "counter-clockwise"
            words.append(f"turned by {abs(self.angle_deg):.1f} degrees {way}")
        if abs(self.scale - 1) >= 0.005:
            size = "large" if self.scale > 1 else "small"
            words.append(f"{abs(self.scale - 1):.1%} too {size}")
        fit = f"correlation {self.correlation:.2f}, as they are {self.as_given:.2f}"
        return f"{', '.join(words)} ({fit})"


def estimate_placement(pairs: Sequence[FramePair], events: EventSource) -> Placement | None:
    """Where events lie, if it is surely not in the pixels of the frames; else None.

    Found are shifts up to a fifth of the picture's shorter side, with turns and scales of a few
    degrees and per cent. Clocks may differ by up to 0.1 s.
    """
    alike = [pair for pair in pairs if pair.change.shape == pairs[0].change.shape]
    chosen = evenly_spread(alike, _MOST_PAIRS)
    if len(chosen) < 2:
        return None
    height, width = chosen[0].change.shape
    step = math.ceil(max(height, width) / _SIDE)
    frames = square_means(np.stack([change_map(pair) for pair in chosen]), step)
    gap_us = float(np.median([pair.gap_us for pair in chosen]))
    most = 1 + math.ceil(max(SEARCH_US / gap_us, 1) * _STEPS)
    lags = np.arange(-most, most + 1) * gap_us / _STEPS
    size = width, height
    sums = (Told(pair, events, lags[-1], size, step).maps(lags) for pair in chosen)
    told = np.stack(list(sums), axis=1)
    if not frames.any() or not told.any():
        return None
    coarse = range(1, len(lags), 2)
    found = _best(frames, told, (0, 0), coarse)
    if found[0] < _BEYOND_DOUBT:
        ways = ((1, 0), (0, 1), (1, 1))
        mirrored = [_best(frames, told, flips, coarse) for flips in ways]
        found = max((found, *mirrored), key=lambda one: one[0])
    near = _best(frames, told, found[1], (found[2] - 1, found[2] + 1))
    _, flips, lag, start = max(found, near, key=lambda one: one[0])
    if lag in (0, len(lags) - 1):  # clocks that differ by more move what moves
        return None
    seen = _flipped(told[lag], flips)
    whole = _fitted(frames, seen, start, _BLURS)
    rows = slice(None, None, 2), slice(1, None, 2)
    few = _BLURS[-_STEPS_OF_HALVES:]
    halves = [_fitted(frames[one], seen[one], whole, few) for one in rows]
    if any(_apart(frames, whole, half) > _AGREEING_PX for half in halves):
        return None
    here = [(frames * maps).sum() / max(1e-9, np.linalg.norm(maps)) for maps in told]
    given = _correlation(frames, told[int(np.argmax(here))], np.zeros(4))
    best = _correlation(frames, seen, whole)
    if best < SURE or 1 - max(given, 0.0) / best < LEAST_GAIN:
        return None
    if not any(flips) and _apart(frames, whole, np.zeros(4)) < LEAST_PX:
        return None
    scale = math.hypot(1 + whole[0], whole[1])
    return Placement(
        (bool(flips[0]), bool(flips[1])),
        (float(whole[2] * step), float(whole[3] * step)),
        math.degrees(math.atan2(whole[1], 1 + whole[0])),
        scale,
        best,
        max(given, 0.0),
        size,
        # of the maps, whose squares leave out what remains at the right and below
        ((width // step * step - 1) / 2, (height // step * step - 1) / 2),
    )


def _flipped(maps: np.ndarray, flips: tuple[int, int]) -> np.ndarray:
    """Maps mirrored left to right, top to bottom, about the picture's middle."""
    maps = maps[..., ::-1] if flips[0] else maps
    return maps[..., ::-1, :] if flips[1] else maps


def _best(
    frames: Map,
    told: Float32[np.ndarray, "L P h w"],
    flips: tuple[int, int],
    lags: Iterable[int],
) -> tuple[float, tuple[int, int], int, Affine]:
    """The highest correlation at any of the lags, and any shift, and which they are."""
    height, width = frames.shape[1:]
    reach = round(_REACH * min(height, width))
    size = height + reach, width + reach
    shifts = np.arange(-reach, reach + 1)
    spectrum = np.conj(np.fft.rfft2(frames, size))
    energy = float(np.square(frames).sum())
    found = (-1.0, flips, 1, np.zeros(4))
    for lag in lags:
        maps = told[lag]
        norm = math.sqrt(energy * float(np.square(maps).sum()))
        if norm == 0:
            continue
        moved = np.fft.rfft2(_flipped(maps, flips), size) * spectrum
        at = np.fft.irfft2(moved.sum(0), size)[np.ix_(shifts, shifts)] / norm
        y, x = np.unravel_index(int(at.argmax()), at.shape)
        if at[y, x] > found[0]:
            start = np.array([0.0, 0.0, shifts[x], shifts[y]])
            found = (float(at[y, x]), flips, lag, start)
    return found


def _fitted(frames: Map, told: Map, start: Affine, blurs: Sequence[float]) -> Affine:
    """From frames to events: least squares of what events lack, step by step (Lucas and Kanade)."""
    affine = start.astype(np.float64)
    height, width = frames.shape[1:]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = x - (width - 1) / 2, y - (height - 1) / 2
    for blur in blurs:
        target = blurred(frames, blur)
        seen = _laid(blurred(told, blur), affine)
        down, right = np.gradient(seen, axis=(1, 2))
        columns = [target, -(right * x + down * y), -(down * x - right * y), -right, -down]
        design = np.stack([column.ravel() for column in columns], axis=1)
        found = np.linalg.lstsq(design.T @ design, design.T @ seen.ravel(), rcond=None)[0]
        affine = affine + found[1:]
        affine[:2] = np.clip(affine[:2], -_FARTHEST, _FARTHEST)
    return affine


def _laid(told: Map, affine: Affine) -> Map:
    """Events' maps in the pixels of the frames."""
    height, width = told.shape[1:]
    centre = np.array([(height - 1) / 2, (width - 1) / 2])
    a, b, right, down = affine
    matrix = np.array([[1 + a, b], [-b, 1 + a]])  # of (row, column)
    offset = centre + (down, right) - matrix @ centre
    return np.stack([affine_transform(one, matrix, offset, order=1) for one in told])


def _correlation(frames: Map, told: Map, affine: Affine) -> float:
    one = blurred(frames, _BLURS[-1])
    other = _laid(blurred(told, _BLURS[-1]), affine)
    size = math.sqrt(float(np.square(one).sum()) * float(np.square(other).sum()))
    return float((one * other).sum()) / size if size > 0 else 0.0


def _moved(points: Float[np.ndarray, "N 2"], affine: Affine) -> Float[np.ndarray, "N 2"]:
    """Where points (x, y), from the middle of the frames, lie among the events."""
    a, b, right, down = affine
    return points @ np.array([[1 + a, b], [-b, 1 + a]]) + (right, down)


def _apart(frames: Map, one: Affine, other: Affine) -> float:
    """Pixels that lie between two places of half of what changes, or more."""
    weight = np.abs(frames).sum(0)
    height, width = weight.shape
    y, x = np.mgrid[:height, :width]
    points = np.stack([x - (width - 1) / 2, y - (height - 1) / 2], axis=-1).reshape(-1, 2)
    far = np.linalg.norm(_moved(points, one) - _moved(points, other), axis=1)
    order = np.argsort(far)
    share = np.cumsum(weight.ravel()[order])
    return float(far[order][np.searchsorted(share, share[-1] / 2)])
