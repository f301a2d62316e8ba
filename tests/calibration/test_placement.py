"""Events that lie beside the pixels of the frames, by known ways, are told as they were moved."""

from dataclasses import replace

import numpy as np
import pytest

from evsplat.calibration import FramePair, estimate_placement
from evsplat.events import EventStream
from evsplat.events import moved as moved_by

from .film import FRAMES, HEIGHT, PERIOD_US, WIDTH, filmed_swing

LOOKS_ALIKE = 92_461
"""Of a film that correlates by more than a half with its mirror's."""


def filmed(seed: int) -> tuple[list[FramePair], EventStream]:
    film = filmed_swing(seed)
    return film.pairs, film.events


def moved(
    events: EventStream, right: float, down: float, angle_deg: float = 0.0, scale: float = 1.0
) -> EventStream:
    """Turned and scaled about the middle of the picture, then shifted; what falls out is lost."""
    turn = scale * np.exp(1j * np.radians(angle_deg))
    middle = complex(WIDTH - 1, HEIGHT - 1) / 2
    place = (events.x + 1j * events.y.astype(float) - middle) * turn + middle + complex(right, down)
    x, y = np.rint(place.real), np.rint(place.imag)
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    x, y = (np.where(inside, value, 0).astype(np.uint16) for value in (x, y))
    return replace(events, x=x, y=y).take(inside)


@pytest.fixture(params=[None, None, None, LOOKS_ALIKE])
def seed(request: pytest.FixtureRequest, rng: np.random.Generator) -> int:
    return request.param or int(rng.integers(1_000_000))


def test_events_in_their_place_are_not_told_whatever_the_clock_and_the_noise(seed: int) -> None:
    pairs, events = filmed(seed)
    rng = np.random.default_rng(seed)
    assert estimate_placement(pairs, events) is None
    for late_us in (8_000, -25_000, 55_000, 95_000):
        assert estimate_placement(pairs, replace(events, t=events.t + late_us)) is None
    thinned = events.take(rng.random(len(events)) < 0.3)
    assert estimate_placement(pairs, thinned) is None
    noise = EventStream(
        np.sort(rng.integers(0, FRAMES * PERIOD_US, 5_000)),
        rng.integers(0, WIDTH, 5_000).astype(np.uint16),
        rng.integers(0, HEIGHT, 5_000).astype(np.uint16),
        rng.choice(np.array([-1, 1], np.int8), 5_000),
    )
    assert estimate_placement(pairs, noise) is None


def test_events_of_another_scene_are_not_said_to_lie_somewhere(seed: int) -> None:
    pairs, _ = filmed(seed)
    assert estimate_placement(pairs, filmed(seed + 1)[1]) is None
    assert estimate_placement(pairs[:1], filmed(seed)[1]) is None
    still = [replace(one, change=np.zeros_like(one.change)) for one in pairs]
    assert estimate_placement(still, filmed(seed)[1]) is None


def test_shift_turn_and_scale_are_those_by_which_events_were_moved(seed: int) -> None:
    pairs, events = filmed(seed)
    rng = np.random.default_rng(seed)
    far, way = rng.uniform(3, 9), rng.uniform(0, 2 * np.pi)
    right, down = np.rint([far * np.cos(way), far * np.sin(way)]).tolist()
    found = estimate_placement(pairs, moved(events, right, down))
    assert found is not None and found.mirrored == (False, False)
    assert found.shift_px == pytest.approx((right, down), abs=0.4)
    assert abs(found.angle_deg) < 0.7 and found.scale == pytest.approx(1, abs=0.015)
    assert found.correlation > 0.8 > found.as_given
    angle, scale = rng.choice([-3, 3]), rng.choice([0.96, 1.04])
    found = estimate_placement(pairs, moved(events, right, down, angle, scale))
    assert found is not None
    assert found.shift_px == pytest.approx((right, down), abs=0.4)
    assert found.angle_deg == pytest.approx(angle, abs=0.7)
    assert found.scale == pytest.approx(scale, abs=0.015)


def test_a_mirror_whose_middle_is_not_the_pictures_is_told_with_the_shift(seed: int) -> None:
    """As of a beam splitter, of which nothing fits in its pixels, mirrored or not."""
    pairs, events = filmed(seed)
    turned = replace(events, x=(WIDTH - 1 - events.x).astype(np.uint16))
    found = estimate_placement(pairs, moved(turned, 6, -2))
    assert found is not None and found.mirrored == (True, False)
    # before all else: what is shifted first to the right is mirrored to the left
    assert found.shift_px == pytest.approx((-6, -2), abs=0.4)
    assert str(found).startswith("mirrored left to right, ")


def coarse(
    pairs: list[FramePair], events: EventStream, factor: int, more: int
) -> tuple[list[FramePair], EventStream]:
    """Each pixel ``factor`` by ``factor`` of them, each with its events, and ``more`` beside."""

    def grown(values: np.ndarray) -> np.ndarray:
        return np.pad(values.repeat(factor, 0).repeat(factor, 1), ((0, more), (0, more)))

    fine = [replace(one, change=grown(one.change), usable=grown(one.usable)) for one in pairs]
    count = factor**2
    row, column = (np.tile(at.ravel(), len(events)) for at in np.mgrid[:factor, :factor])
    x, y = (factor * np.repeat(values, count) for values in (events.x, events.y))
    places = (x + column).astype(np.uint16), (y + row).astype(np.uint16)
    return fine, EventStream(np.repeat(events.t, count), *places, np.repeat(events.p, count))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("factor", [1, 2])
def test_events_are_moved_back_by_what_was_found(seed: int, mirrored: bool, factor: int) -> None:
    """Those of larger pictures too, which are compared as means that leave out the last pixels."""
    pairs, events = filmed(seed)
    more = 0 if factor == 1 else 1
    pairs, events = coarse(pairs, events, factor, more)
    height, width = pairs[0].change.shape
    rng = np.random.default_rng(seed)
    angle = np.radians(rng.choice([-1, 1]) * rng.uniform(1.5, 3))
    turn = rng.choice([0.97, 1.03]) * np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    away = np.eye(3)
    away[:2, :2] = turn @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    middle = np.array([width - 1, height - 1]) / 2
    away[:2, 2] = middle + factor * rng.uniform(2, 5, 2) - away[:2, :2] @ middle
    numbered = replace(events, t=np.arange(len(events)))
    there = EventStream.joined(list(moved_by([numbered], away, width, height)))
    of = there.t
    found = estimate_placement(pairs, replace(there, t=events.t[of]))
    assert found is not None and found.mirrored == (mirrored, False)
    assert found.size_px == (width, height)
    back = EventStream.joined(list(moved_by([there], found.homography, width, height)))
    apart = np.stack([back.x, back.y]).astype(float) - np.stack([events.x, events.y])[:, back.t]
    # both ways round to pixels
    assert np.median(np.hypot(*apart)) <= factor
    assert np.abs(apart.mean(1)).max() < 0.35 * factor
