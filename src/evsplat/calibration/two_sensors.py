"""Where the events of another sensor lie over pictures, found from what moves in both."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from evsplat.calibration.brightness import Exposure, FramePair, exposure, pair, pair_indices
from evsplat.calibration.change_maps import Map, change_map
from evsplat.calibration.clock import SEARCH_US
from evsplat.calibration.sensor_fit import ANY_HOMOGRAPHY, Fit, Views, any_similarity, fit
from evsplat.calibration.sensor_search import SIDE, Guess, search
from evsplat.calibration.ways import WAYS
from evsplat.events import ALWAYS, EventStream
from evsplat.events.homography import Homography
from evsplat.pictures.light import Transfer
from evsplat.pictures.squares import square_means

SURE = 0.5
"""Events and pictures correlate so well or better at their place."""
RIVAL = 0.8
"""Another place has to be worse than this share of the best one's correlation."""
MOST_ERROR = 0.005
"""Of the longer side: standard error up to which a place is known."""
_PAIRS, _GATHERED = 24, 48
"""Pairs that are compared, those of so many in which most changes."""
_MAP_SIDE, _SENSOR_SIDE = 160, 96
_MOST_EVENTS = 6_000_000
_NEAR = 0.1
"""Of the longer side: guesses that lie so near each other, over what moves, are one."""
_COARSE, _FINE = (3.0, 2.0, 1.0), (1.0,)
"""Standard deviations of blurs for the fits, one after the other."""
_SURELY_APART = 1.4
"""A homography has to put what moves so many of its standard errors away from where a similarity
does: perspective that is not there costs where nothing moves."""
_MOVES = 0.8
"""Pixels are asked for errors that change more than this share of all."""


@dataclass(frozen=True)
class SensorPlace:
    """Where the events of another sensor lie over pictures, and how certain that is."""

    homography: Homography
    """By which `evsplat.events.moved` brings events into the pixels of the pictures."""
    is_similarity: bool
    """No perspective, because the recording tells of none."""
    way: str
    """How events are mirrored or turned: one of `evsplat.calibration.ways.WAYS`."""
    inverted: bool
    """True where they say darker of what grows brighter."""
    correlation: float
    rival: float
    """The highest correlation at another place, in the rough search."""
    rough: float
    """That of the place found, there."""
    halves_agree: bool
    """Whether each half of the pairs leads to the same place."""
    error_px: float
    """Standard error where something moves, in pixels of the pictures; infinite where few tell."""
    lag_us: float
    """How much later than the frames events are stamped."""
    size_px: tuple[int, int]
    """Width and height of the pictures."""
    sensor_px: tuple[int, int]

    @property
    def doubt(self) -> str:
        """Why it is not to be relied on, following "its events"; empty where it is."""
        fit = f"(correlation {self.correlation:.2f}"
        if not self.correlation >= SURE:
            return f"agree with the changes of the pictures nowhere {fit} at best)"
        if self.rival >= RIVAL * self.rough:
            return (
                f"agree with the changes of the pictures at one place {fit[:13]}{self.rough:.2f}) "
                f"hardly better than elsewhere ({self.rival:.2f})"
            )
        if not self.halves_agree:
            return f"agree with halves of the pictures' changes at two places {fit})"
        if abs(self.lag_us) >= SEARCH_US:
            return f"have a clock that is off by {SEARCH_US / 1000:g} ms or more"
        if not math.isfinite(self.error_px):
            return f"are there for too few of the pictures' changes to tell where they lie {fit})"
        if not self.error_px <= MOST_ERROR * max(self.size_px):
            return f"tell where they belong to {self.error_px:.1f} px only, as too little moves"
        return ""

    def __str__(self) -> str:
        """Such as "640x480 pixels, scaled by 0.41 and turned by 2.1 degrees clockwise"."""
        turn = self.homography[:2, :2] @ WAYS[self.way].T
        middle = np.array([(side - 1) / 2 for side in self.sensor_px] + [1.0])
        x, y, w = self.homography @ middle
        right, down = np.array([x, y]) / w - (np.array(self.size_px) - 1) / 2
        angle = math.degrees(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        words = [f"{self.sensor_px[0]}x{self.sensor_px[1]} pixels"]
        words += [self.way] if self.way else []
        words.append(f"scaled by {math.sqrt(abs(np.linalg.det(turn))):.3g}")
        words.append(f"turned by {abs(angle):.1f} degrees {'counter-' * (angle < 0)}clockwise")
        words.append(f"its middle {right:+.1f} px right and {down:+.1f} px down of the pictures'")
        if not self.is_similarity:
            words.append("with perspective")
        return ", ".join(words)


class ChangesSeen:
    """Changes between pairs of pictures, gathered as these are read one at a time."""

    def __init__(self, spans_us: Sequence[tuple[int, int]], transfer: Transfer) -> None:
        """``spans_us``: start and end of the exposures of all pictures that will be added."""
        self._transfer = transfer
        self._pairs = pair_indices(spans_us, _GATHERED)
        self._kept: dict[int, Exposure] = {}
        self._count = 0
        self.pairs: list[FramePair] = []
        """Of means over squares of ``step`` pixels."""
        self.size: tuple[int, int] = (0, 0)
        self.step = 1

    def add(self, image: Callable[[], Float[Tensor, "..."]], span_us: tuple[int, int]) -> None:
        """The next picture, (H, W) or (H, W, 3) of coded values in [0, 1], and its exposure.

        It is asked for where a pair needs it.
        """
        index, self._count = self._count, self._count + 1
        before = [first for first, after in self._pairs if after == index]
        if not before and not any(first == index for first, _ in self._pairs):
            return
        seen = exposure(image(), span_us, transfer=self._transfer)
        height, width = seen.log_luminance.shape
        self.size, self.step = (width, height), math.ceil(max(height, width) / _MAP_SIDE)
        for first in before:
            fine = pair(self._kept[first], seen, ALWAYS)
            change = square_means(change_map(fine), self.step)
            self.pairs.append(replace(fine, change=change, usable=np.ones(change.shape, bool)))
        self._kept[index] = seen
        needed = {first for first, after in self._pairs if after > index}
        self._kept = {one: kept for one, kept in self._kept.items() if one in needed}

    def events(self, pieces: Iterable[EventStream], offset_us: int) -> EventStream:
        """Those near the pairs, of at most some millions each n-th, at times of the frames' clock.

        ``pieces`` are the consecutive pieces of the recording, whose clock ``offset_us`` brings to
        that of the frames.
        """
        spans = np.array([one.span_us for one in self.pairs]).reshape(-1, 2)
        spans = spans + np.array([-SEARCH_US, SEARCH_US]) - offset_us
        kept: list[EventStream] = []
        count, share, passed = 0, 1, 0
        for piece in pieces:
            near = np.zeros(len(piece), bool)
            for first, end in np.searchsorted(piece.t, spans):
                near[first:end] = True
            near[near] = (passed + np.arange(near.sum())) % share == 0
            passed += int(near.sum())
            if not near.any():
                continue
            taken = piece.take(near)
            kept.append(replace(taken, t=np.asarray(taken.t, np.int64) + offset_us))
            count += len(taken)
            if count > _MOST_EVENTS:
                kept = [EventStream.joined(kept).take(slice(None, None, 2))]
                count, share = len(kept[0]), share * 2
        return EventStream.joined(kept)


def estimate_place(
    seen: ChangesSeen, events: EventStream, size: tuple[int, int]
) -> SensorPlace | None:
    """Where ``events`` of a sensor of ``size``, width and height, lie over the pictures.

    None where nothing moves, or events tell nothing. Found are all mirrors and quarter turns,
    scales of 0.57 to 1.75 beside what would let both see as much, turns up to ten degrees, shifts
    up to a third of the picture. Clocks may differ by up to 0.1 s. Whether it is to be relied on
    says `SensorPlace.doubt`.
    """
    pairs = _most_changing(seen.pairs)
    changes = np.stack([change_map(one) for one in pairs]) if pairs else np.zeros((0, 1, 1))
    if len(pairs) < 2 or not changes.any() or not len(events):
        return None
    rough = math.ceil(max(changes.shape[1:]) / SIDE)
    frames = square_means(changes, rough)
    step = math.ceil(max(size) / _SENSOR_SIDE)
    gap_us = float(np.median([one.gap_us for one in pairs]))
    count = math.ceil(2 * SEARCH_US / gap_us)
    lags = np.arange(-count, count + 1) * gap_us / 2
    views = Views(frames, pairs, events, size, step, float(lags[-1]))
    told = views.told(lags)
    if not told.any():
        return None
    guesses = search(frames, told, 2)
    best = guesses[0][0]
    apart = _Apart(frames, best)
    rival = max((abs(one.score) for one in guesses[0] if apart(one) > _NEAR), default=0.0)
    agree = all(apart(half[0]) <= _NEAR for half in guesses[1:])
    events = replace(events, p=-events.p) if best.score < 0 else events
    to_picture = _middle(frames.shape[1:], rough * seen.step)
    to_sensor = _middle(views.sensor, step)
    homography = np.linalg.inv(to_picture) @ best.affine @ to_sensor
    homography, found, error = _fitted(
        replace(views, frames=changes, events=events), seen.step, homography, float(lags[best.lag])
    )
    return SensorPlace(
        homography=homography,
        is_similarity=not np.abs(homography[2, :2]).any(),
        way=best.way,
        inverted=best.score < 0,
        correlation=found.correlation,
        rival=rival,
        rough=abs(best.score),
        halves_agree=agree,
        error_px=error,
        lag_us=found.lag_us,
        size_px=seen.size,
        sensor_px=size,
    )


def _most_changing(pairs: Sequence[FramePair]) -> list[FramePair]:
    """Those in which most changes, in their order."""
    power = [float(np.square(change_map(one)).sum()) for one in pairs]
    chosen = np.sort(np.argsort(power)[::-1][:_PAIRS])
    return [pairs[index] for index in chosen]


def _fitted(
    views: Views, step: int, homography: Homography, lag_us: float
) -> tuple[Homography, Fit, float]:
    """From pixels of the sensor to those of the pictures, its fit, and its standard error in px.

    ``step``: pixels of the pictures to one of the maps of ``views``.
    """
    # maps are no finer than what either camera sees
    scale = math.sqrt(abs(np.linalg.det(homography[:2, :2])))
    coarser = max(1, math.ceil(0.75 * scale / step))
    frames = square_means(views.frames, coarser)
    step *= coarser
    views = replace(views, frames=frames, step=max(1, round(step / scale)))
    to_picture = _middle(frames.shape[1:], step, unit=True)
    to_sensor = _middle(views.sensor, views.step, unit=True)
    start = to_sensor @ np.linalg.inv(to_picture @ homography)
    basis = any_similarity(start)
    found = fit(views, start, lag_us, basis, _COARSE)
    free = fit(views, found.matrix, found.lag_us, ANY_HOMOGRAPHY, _FINE)
    half = max(frames.shape[1:]) / 2 * step
    told = half * found.error(views, basis, views.grid)
    of_free = _of_most(half * free.error(views, ANY_HOMOGRAPHY, views.grid), frames)
    apart = half * free.apart(found, views.grid)
    surely = _of_most(apart, frames) > _SURELY_APART * of_free
    if surely and free.correlation > found.correlation and of_free <= MOST_ERROR * 2 * half:
        found, error = free, of_free
    else:  # what a similarity leaves out is an error too
        error = _of_most(np.hypot(told, apart), frames)
    place = np.linalg.inv(to_picture) @ np.linalg.inv(found.matrix) @ to_sensor
    place /= place[2, 2]
    if not np.abs(found.matrix[2, :2]).any():
        place[2, :2] = 0.0  # but for rounding
    return place, found, error


def _of_most(error: Float[np.ndarray, "N"], frames: Map) -> float:
    """The error up to which nine tenths of what moves lie."""
    weight = np.abs(frames).sum(0).ravel()
    weight = np.where(weight >= np.quantile(weight, _MOVES), weight, 0)
    order = np.argsort(error)
    share = np.cumsum(weight[order])
    return float(error[order][np.searchsorted(share, 0.9 * share[-1])])


def _middle(shape: tuple[int, ...], step: int, *, unit: bool = False) -> Float[np.ndarray, "3 3"]:
    """From pixels to maps (height, width) of means over ``step`` of them, from the middle.

    In pixels of the maps; with ``unit`` 1 is at the end of the longer side.
    """
    height, width = shape
    scale = 2 / max(height, width) if unit else 1.0
    matrix = np.diag([scale / step, scale / step, 1.0])
    matrix[:2, 2] = -scale * (np.array([width, height]) - 1 + (step - 1) / step) / 2
    return matrix


class _Apart:
    """How far from the place of a guess others put what moves, as a share of the longer side."""

    def __init__(self, frames: Map, best: Guess) -> None:
        height, width = frames.shape[1:]
        y, x = np.mgrid[:height, :width]
        points = np.stack([x - (width - 1) / 2, y - (height - 1) / 2, np.ones((height, width))])
        self._points = points.reshape(3, -1)
        power = np.square(frames).sum(0).ravel()
        self._share = power / power.sum()
        self._back = np.linalg.inv(best.affine)
        self._side = max(height, width)

    def __call__(self, other: Guess) -> float:
        moved = other.affine @ self._back @ self._points - self._points
        return math.sqrt(float(self._share @ np.square(moved).sum(0))) / self._side
