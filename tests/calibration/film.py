"""A film of something that swings before a wall, with the events of ideal pixels."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates

from evsplat.calibration import FramePair, exposure, pair
from evsplat.calibration.two_sensors import ChangesSeen, SensorPlace, estimate_place
from evsplat.calibration.ways import WAYS, way_homography
from evsplat.events import ALWAYS, EventStream

WIDTH, HEIGHT, FRAMES = 96, 80, 9
PERIOD_US, STEP_US, EXPOSURE_US = 40_000, 2_000, 8_000


@dataclass(frozen=True, eq=False)
class Film:
    """What two cameras of one view recorded."""

    pictures: list[Float[np.ndarray, "H W"]]
    """Coded values in [0, 1]."""
    spans_us: list[tuple[int, int]]
    events: EventStream

    @property
    def pairs(self) -> list[FramePair]:
        """Neighbouring pictures."""
        seen = [
            exposure(torch.from_numpy(picture), span)
            for picture, span in zip(self.pictures, self.spans_us, strict=True)
        ]
        return [pair(a, b, ALWAYS) for a, b in zip(seen, seen[1:], strict=False)]


@functools.cache
def filmed_swing(seed: int) -> Film:
    """Something with a pattern that goes and turns before a wall with one, by ideal pixels.

    It swings: of what goes evenly a shift along its way is as if it came later.
    """
    rng = np.random.default_rng(seed)
    wall, coat = (gaussian_filter(rng.standard_normal((HEIGHT, WIDTH)), 2.5) * 5 for _ in range(2))
    way, turn = rng.uniform(-7, 7, 2), rng.uniform(-0.2, 0.2)
    begin = rng.uniform(0, 2 * np.pi)
    grid = np.stack(np.mgrid[:HEIGHT, :WIDTH]).astype(float) - np.array(
        [[[HEIGHT / 2]], [[WIDTH / 2]]]
    )

    def level(time_us: float) -> np.ndarray:
        swing = np.sin(begin + 8 * time_us / (FRAMES * PERIOD_US))
        angle = turn * swing
        y, x = grid - (swing * way)[:, None, None]
        rows = np.cos(angle) * y - np.sin(angle) * x
        columns = np.sin(angle) * y + np.cos(angle) * x
        inside = 1 / (1 + np.exp(np.maximum((np.hypot(rows / 26, columns / 16) - 1) * 20, -50)))
        pattern = map_coordinates(
            coat, [rows + HEIGHT / 2, columns + WIDTH / 2], order=1, mode="mirror"
        )
        return -1.6 + (1 - inside) * wall * 0.5 + inside * (pattern + 0.3)

    reference = level(0) + rng.uniform(-0.2, 0.2, (HEIGHT, WIDTH))
    events = []
    for time in range(0, FRAMES * PERIOD_US, STEP_US):
        now = level(time)
        for sign in (1, -1):
            while (passed := sign * (now - reference) >= 0.2).any():
                y, x = np.nonzero(passed)
                events.append((np.full(len(x), time), x, y, np.full(len(x), sign)))
                reference[passed] += sign * 0.2
    t, x, y, p = (np.concatenate(column) for column in zip(*events, strict=True))
    stream = EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))
    spans = [(k * PERIOD_US, k * PERIOD_US + EXPOSURE_US) for k in range(FRAMES)]
    pictures = [
        np.mean([np.exp(level(u)) for u in np.linspace(*span, 5)], axis=0) ** (1 / 2.2)
        for span in spans
    ]
    return Film(pictures, spans, stream)


def drawn_place(
    rng: np.random.Generator, *, perspective: float = 0.0
) -> tuple[np.ndarray, tuple[int, int]]:
    """From the pictures to a sensor of another size and shape, which sees about as much."""
    long = rng.uniform(0.6, 1.8) * WIDTH
    size = round(long), round(long * rng.choice([0.6, 0.75, 1.0]))
    fits = size[0] / WIDTH, size[1] / HEIGHT
    scale, angle = math.sqrt(fits[0] * fits[1]) * rng.uniform(0.9, 1.1), rng.uniform(-0.08, 0.08)
    matrix = np.eye(3)
    matrix[:2, :2] = scale * np.array(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    away, to = np.eye(3), np.eye(3)
    away[:2, 2] = -(WIDTH - 1) / 2, -(HEIGHT - 1) / 2
    to[:2, 2] = (np.array(size) - 1) / 2 + rng.uniform(-0.05, 0.05, 2) * size
    lean = np.eye(3)
    lean[2, :2] = perspective / WIDTH * rng.choice([-1, 1], 2)
    return to @ matrix @ lean @ away, size


def turned_sensor(
    matrix: np.ndarray, size: tuple[int, int], way: str
) -> tuple[np.ndarray, tuple[int, int]]:
    """As of `drawn_place`, of a sensor that sees it mirrored or turned, one of `WAYS`."""
    # from the frames to the events is the other way round
    back = WAYS[way].T
    turned = size if back[0, 0] else size[::-1]
    away = way_homography(back, size)
    away[:2, 2] = (np.array(turned) - 1) / 2 - back @ ((np.array(size) - 1) / 2)
    return away @ matrix, turned


def recorded_by(
    events: EventStream, matrix: np.ndarray, size: tuple[int, int], rng: np.random.Generator
) -> EventStream:
    """Each event somewhere in its pixel, then in the sensor's; what falls out is lost."""
    inside_px = rng.uniform(-0.5, 0.5, (2, len(events)))
    x, y, w = matrix @ np.stack(
        [events.x + inside_px[0], events.y + inside_px[1], inside_px[0] ** 0]
    )
    x, y = np.rint(x / w), np.rint(y / w)
    seen = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
    place = (np.where(seen, value, 0).astype(np.uint16) for value in (x, y))
    return EventStream(events.t, *place, events.p).take(seen)


def gathered_changes(film: Film) -> ChangesSeen:
    """Those between the film's pictures."""
    seen = ChangesSeen(film.spans_us, "power")
    for picture, span in zip(film.pictures, film.spans_us, strict=True):
        seen.add(lambda picture=picture: torch.from_numpy(picture), span)
    return seen


def found(film: Film, events: EventStream, size: tuple[int, int]) -> SensorPlace | None:
    """Where events of a sensor lie over the film's pictures."""
    seen = gathered_changes(film)
    return estimate_place(seen, seen.events([events], 0), size)


def drawn_film(rng: np.random.Generator) -> Film:
    """One whose changes are like themselves at one place only.

    Hardly one in a hundred looks alike elsewhere too, when it is right to rely on nothing.
    """
    for _ in range(10):
        film = filmed_swing(int(rng.integers(1_000_000)))
        place = found(film, film.events, (WIDTH, HEIGHT))
        if place is not None and place.rival < 0.7 * place.rough:
            return film
    raise AssertionError("ten films in a row look alike at two places")
