"""A similarity or a homography between pictures and another sensor's events, from a rough guess.

Least squares of what events lack to be what frames change by, step by step (Lucas and Kanade), of
the place and of the lag of the events' clock together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import map_coordinates

from evsplat.calibration.brightness import EventSource, FramePair
from evsplat.calibration.change_maps import Map, Told, blurred

_GROUPS = 8
"""Stretches of the recording, each of which is left out once to see what that changes."""
_FEWEST = 6
"""Of them with events, below which nothing is known of errors."""
_ALIKE = 1.5
"""Stretches err alike, as what moves goes on and events are late by more of what is slow: errors
are larger by this than stretches differ by (docs/experiments/ladder.md)."""
_NUMBERS = 10
"""Fitted at most: gain, lag, and the first eight numbers of the matrix."""
_LAG_STEP_US = 1_000.0
_DAMPING = 1e-6
_MOST_STEPS, _LONGEST_STEP = 5, 16
_STILL, _STILL_US = 3e-4, 100.0
"""A step that moves no corner by so much of half the sensor's side, and the clock by no more, is
the last: a fiftieth of a pixel of the maps."""
_CORNERS = np.array([[-1.0, 1, -1, 1], [-1, -1, 1, 1], [1, 1, 1, 1]])

Matrix = Float[np.ndarray, "3 3"]
Basis = Float[np.ndarray, "10 K"]
"""Which of the numbers change, and which of them together."""

ANY_HOMOGRAPHY: Basis = np.eye(_NUMBERS)


def any_similarity(matrix: Matrix) -> Basis:
    """What leaves a similarity one, of the handedness of ``matrix``."""
    sign = np.sign(np.linalg.det(matrix[:2, :2]))
    basis = np.zeros((_NUMBERS, 6))
    basis[0, 0] = basis[1, 1] = 1
    basis[[2, 6], 2] = 1, sign
    basis[[3, 5], 3] = -sign, 1
    basis[4, 4] = basis[7, 5] = 1
    return basis


@dataclass(frozen=True, eq=False)
class Views:
    """What is laid onto each other: maps of frames, and the events of the same pairs."""

    frames: Map
    pairs: Sequence[FramePair]
    events: EventSource
    size: tuple[int, int]
    """Width and height of the sensor."""
    step: int
    """Pixels of the sensor to one of its maps."""
    most_lag_us: float
    """Clocks differ by no more."""

    @property
    def sensor(self) -> tuple[int, int]:
        """Height and width of the sensor's maps."""
        return self.size[1] // self.step, self.size[0] // self.step

    @property
    def grid(self) -> Float[np.ndarray, "3 N"]:
        """Points (x, y, 1) of the frames' maps, from the middle; 1 is at the longer side's end."""
        height, width = self.frames.shape[1:]
        y, x = np.mgrid[:height, :width] * 2.0
        points = np.stack([x - (width - 1), y - (height - 1)]) / max(height, width)
        return np.concatenate([points.reshape(2, -1), np.ones((1, x.size))])

    def told(self, lags_us: Float[np.ndarray, "L"]) -> Float32[np.ndarray, "L P h w"]:
        """What events add up to at each lag, in the sensor's own pixels."""
        return np.stack([one.maps(lags_us) for one in self._told], axis=1)

    @cached_property
    def _told(self) -> list[Told]:
        most = self.most_lag_us + _LAG_STEP_US
        return [Told(one, self.events, most, self.size, self.step) for one in self.pairs]


@dataclass(frozen=True, eq=False)
class Fit:
    """A place of the events and their clock, and the equations of the next step from there."""

    matrix: Matrix
    """From the frames' `Views.grid` to the sensor's, whose maps are measured likewise."""
    lag_us: float
    blur: float
    """Standard deviation in pixels of the frames' maps."""
    correlation: float
    normal: Float[np.ndarray, "G 10 10"]
    right: Float[np.ndarray, "G 10"]
    squares: Float[np.ndarray, "G"]
    """Of what events tell, summed."""

    def step(self, basis: Basis, without: int | None = None) -> Float[np.ndarray, "10"]:
        """What to add to the numbers, by all groups or all but one; of the gain its value."""
        normal, right = basis.T @ self.normal @ basis, self.right @ basis
        kept = [group for group in range(len(right)) if group != without]
        matrix, vector = normal[kept].sum(0), right[kept].sum(0)
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        alike = matrix / np.outer(size, size) + _DAMPING * np.eye(len(size))
        found: Float[np.ndarray, 10] = basis @ (np.linalg.solve(alike, vector / size) / size)
        return found

    def apart(self, other: "Fit", points: Float[np.ndarray, "3 N"]) -> Float[np.ndarray, "N"]:
        """How far from each other two fits put points of the frames' grid, in its unit."""
        moved = _projected(np.linalg.inv(self.matrix) @ other.matrix, points)
        return np.hypot(*(moved - points[:2]))

    def error(
        self, views: Views, basis: Basis, points: Float[np.ndarray, "3 N"]
    ) -> Float[np.ndarray, "N"]:
        """Standard error of where points of the frames' grid lie, in its unit.

        Jackknife over groups, which are stretches of the recording; infinite where few tell. Steps
        follow the slopes of the frames: by those of the events, whose noise is in them, all groups'
        steps are too short to tell how far each one leads.
        """
        told = [group for group, rest in enumerate(self.squares) if rest > 0]
        if len(told) < _FEWEST:
            return np.full(points.shape[1], np.inf)
        normal, right = np.zeros_like(self.normal), np.zeros_like(self.right)
        for laid in _laid(views, self.matrix, self.lag_us, self.blur):
            smooth = laid.columns(laid.slopes_of_frames())
            normal[laid.group] += smooth @ laid.columns(laid.slopes).T
            right[laid.group] += smooth @ laid.value
        by_frames = replace(self, normal=normal, right=right)
        back = np.linalg.inv(self.matrix)
        whole = by_frames.step(basis)
        steps = [by_frames.step(basis, without=group) - whole for group in told]
        places = np.stack([_projected(back @ _changed(self.matrix, one), points) for one in steps])
        share = (len(told) - 1) / len(told)
        far = np.square(places - places.mean(0)).sum((0, 1))
        return _ALIKE * np.sqrt(share * far)


def fit(
    views: Views,
    matrix: Matrix,
    lag_us: float,
    basis: Basis,
    blurs: Sequence[float],
) -> Fit:
    """From ``matrix`` and ``lag_us`` to where events fit, by each of ``blurs`` in turn.

    These are in pixels of the frames' maps. Noise of the events makes steps too short, most of all
    those by which a shift and a lag make up for each other, so that each is doubled while it helps.
    """
    most = views.most_lag_us
    found = _equations(views, matrix / matrix[2, 2], lag_us, blurs[0])
    for blur in blurs:
        found = _equations(views, found.matrix, found.lag_us, blur)
        for _ in range(_MOST_STEPS):
            step = found.step(basis)
            moves = np.abs(_projected(_changed(found.matrix, step), _CORNERS)
                           - _projected(found.matrix, _CORNERS)).max()  # fmt: skip
            if moves < _STILL and abs(step[1]) < _STILL_US:
                break
            best, factor = found, 1
            while factor <= _LONGEST_STEP:
                lag = float(np.clip(found.lag_us + factor * step[1], -most, most))
                tried = _equations(views, _changed(found.matrix, factor * step), lag, blur)
                if tried.correlation <= best.correlation:
                    break
                best, factor = tried, 2 * factor
            if best is found:
                break
            found = best
    return found


@dataclass(frozen=True, eq=False)
class _Laid:
    """What events tell of a pair of frames, and what these change by, at pixels that both see."""

    group: int
    matrix: Matrix
    points: Float[np.ndarray, "2 N"]
    """Of the frames' grid."""
    at: Float[np.ndarray, "2 N"]
    """Where these lie on the sensor."""
    w: Float[np.ndarray, "N"]
    change: Float[np.ndarray, "N"]
    change_slopes: Float[np.ndarray, "2 N"]
    """Along rows and columns of the frames' grid."""
    value: Float[np.ndarray, "N"]
    later: Float[np.ndarray, "N"]
    slopes: Float[np.ndarray, "2 N"]
    """Of ``value``, along the sensor's."""

    def columns(self, slopes: Float[np.ndarray, "2 N"]) -> Float[np.ndarray, "10 N"]:
        """By what each number changes what events tell, with its sign: they are told less a step.

        ``slopes``: how that changes along the sensor's rows and columns.
        """
        x, y = self.points
        dx, dy = slopes / self.w
        dw = -(dx * self.at[0] + dy * self.at[1])
        return np.stack([self.change, -self.later,
                         *(-one for d in (dx, dy) for one in (d * x, d * y, d)),
                         -dw * x, -dw * y])  # fmt: skip

    def slopes_of_frames(self) -> Float[np.ndarray, "2 N"]:
        """Those of ``change``, along the sensor's rows and columns."""
        moves = (self.matrix[:2, :2] - self.at.T[..., None] * self.matrix[2, :2]) / self.w[
            :, None, None
        ]
        slopes: Float[np.ndarray, "2 N"] = np.einsum(
            "nij,in->jn", np.linalg.inv(moves), self.change_slopes
        )
        return slopes


def _laid(views: Views, matrix: Matrix, lag_us: float, blur: float) -> Iterator[_Laid]:
    """Each pair of frames, with events laid onto it."""
    height, width = views.sensor
    half = max(height, width) / 2
    grid = views.grid
    w = matrix[2] @ grid
    at = _projected(matrix, grid)
    x, y = at * half + np.array([[(width - 1) / 2], [(height - 1) / 2]])
    inside = (w > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    # blurred alike in the pictures, whatever the size of the pixels
    side = max(views.frames.shape[1:]) / 2
    finer = np.sqrt(abs(np.linalg.det(matrix[:2, :2]))) * half / side
    before, told, after = views.told(lag_us + np.array([-1.0, 0, 1]) * _LAG_STEP_US)
    seen = blurred(told, blur * finer)
    late = blurred(after - before, blur * finer) / (2 * _LAG_STEP_US)
    to = np.stack([y, x])[:, inside]
    for index, frame in enumerate(blurred(views.frames, blur)):
        maps = (seen[index], late[index], *np.gradient(seen[index] * half)[::-1])
        value, later, dx, dy = (map_coordinates(one, to, order=1) for one in maps)
        yield _Laid(
            index * _GROUPS // len(seen),
            matrix,
            grid[:2, inside],
            at[:, inside],
            w[inside],
            frame.ravel()[inside],
            np.stack([one.ravel()[inside] for one in np.gradient(frame * side)[::-1]]),
            value,
            later,
            np.stack([dx, dy]),
        )


def _equations(views: Views, matrix: Matrix, lag_us: float, blur: float) -> Fit:
    """What events tell, as gain times what frames change by less what a step would change."""
    found = Fit(
        matrix,
        lag_us,
        blur,
        0.0,
        np.zeros((_GROUPS, _NUMBERS, _NUMBERS)),
        np.zeros((_GROUPS, _NUMBERS)),
        np.zeros(_GROUPS),
    )
    for laid in _laid(views, matrix, lag_us, blur):
        columns = laid.columns(laid.slopes)
        found.normal[laid.group] += columns @ columns.T
        found.right[laid.group] += columns @ laid.value
        found.squares[laid.group] += laid.value @ laid.value
    power = found.normal[:, 0, 0].sum() * found.squares.sum()
    correlation = found.right[:, 0].sum() / np.sqrt(power) if power > 0 else 0.0
    return replace(found, correlation=float(correlation))


def _changed(matrix: Matrix, step: Float[np.ndarray, "10"]) -> Matrix:
    return matrix + np.append(step[2:], 0).reshape(3, 3)


def _projected(matrix: Matrix, points: Float[np.ndarray, "3 N"]) -> Float[np.ndarray, "2 N"]:
    x, y, w = matrix @ points
    return np.stack([x, y]) / np.where(w > 0, w, np.inf)
