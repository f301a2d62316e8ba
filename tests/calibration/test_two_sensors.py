"""Where the events of another sensor lie over pictures is found, or it is said that it is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.calibration.clock import estimate_clock
from evsplat.calibration.two_sensors import ChangesSeen, SensorPlace
from evsplat.calibration.ways import WAYS
from evsplat.events import EventStream

from .film import (
    FRAMES,
    HEIGHT,
    PERIOD_US,
    WIDTH,
    Film,
    drawn_film,
    drawn_place,
    filmed_swing,
    found,
    gathered_changes,
    recorded_by,
    turned_sensor,
)


def off_px(place: SensorPlace, film: Film, matrix: np.ndarray) -> float:
    """Of where events of the film belong, how far from there most of them are put."""
    points = np.stack([film.events.x, film.events.y, np.ones(len(film.events))])
    back = place.homography @ matrix @ points
    return float(np.quantile(np.hypot(*(back[:2] / back[2] - points[:2])), 0.9))


@pytest.mark.parametrize("perspective", [0.0, 0.12])
def test_scale_turn_shift_and_perspective_are_found_whatever_the_sensors_size(
    rng: np.random.Generator, perspective: float
) -> None:
    film = drawn_film(rng)
    matrix, size = drawn_place(rng, perspective=perspective)
    late = int(rng.integers(-40_000, 40_000))
    events = recorded_by(film.events, matrix, size, rng)
    place = found(film, replace(events, t=events.t + late), size)
    assert place is not None and place.doubt == ""
    assert place.way == "" and not place.inverted and place.sensor_px == size
    assert place.size_px == (WIDTH, HEIGHT)
    # two thirds of a pixel of the sensor or the pictures, whichever is larger
    assert off_px(place, film, matrix) < 0.7 * max(1, WIDTH / size[0])
    # as late as thresholds make a sensor that has the pixels of the pictures
    own = estimate_clock(film.pairs, film.events)
    assert own is not None and place.lag_us - late == pytest.approx(own.lag_us, abs=8_000)


def test_the_error_told_is_about_the_true_one_where_perspective_is_small(
    rng: np.random.Generator,
) -> None:
    """A similarity leaves it out, by more than what stretches of the recording differ by."""
    ratios = []
    for _ in range(4):
        film = filmed_swing(int(rng.integers(1_000_000)))
        matrix, size = drawn_place(rng, perspective=0.06)
        events = recorded_by(film.events, matrix, size, rng)
        count = len(events) // 2
        noise = EventStream(
            rng.integers(0, FRAMES * PERIOD_US, count),
            rng.integers(0, size[0], count).astype(np.uint16),
            rng.integers(0, size[1], count).astype(np.uint16),
            rng.choice(np.array([-1, 1], np.int8), count),
        )
        both = EventStream.joined([events, noise])
        place = found(film, both.take(np.argsort(both.t, kind="stable")), size)
        assert place is not None
        ratios.append(off_px(place, film, matrix) / place.error_px)
    # of 50 films with perspective half are within 1.0, and nine in ten within 1.8
    assert 0.3 < np.median(ratios) < 2


def test_mirrors_quarter_turns_and_the_other_polarity_are_found(rng: np.random.Generator) -> None:
    film = drawn_film(rng)
    name = str(rng.choice([one for one in WAYS if one]))
    matrix, size = turned_sensor(*drawn_place(rng), name)
    events = recorded_by(film.events, matrix, size, rng)
    place = found(film, replace(events, p=-events.p), size)
    assert place is not None and place.doubt == ""
    assert place.way == name and place.inverted and name in str(place)
    assert off_px(place, film, matrix) < 0.7 * max(1, WIDTH / max(size))


def test_events_of_another_scene_or_noise_are_not_relied_on(rng: np.random.Generator) -> None:
    ours, others = (filmed_swing(int(one)) for one in rng.integers(1_000_000, size=2))
    matrix, size = drawn_place(rng)
    place = found(ours, recorded_by(others.events, matrix, size, rng), size)
    assert place is None or place.doubt
    count = 20_000
    noise = EventStream(
        np.sort(rng.integers(0, FRAMES * PERIOD_US, count)),
        rng.integers(0, size[0], count).astype(np.uint16),
        rng.integers(0, size[1], count).astype(np.uint16),
        rng.choice(np.array([-1, 1], np.int8), count),
    )
    place = found(ours, noise, size)
    assert place is None or "nowhere" in place.doubt


def test_events_of_less_than_six_changes_are_not_relied_on(rng: np.random.Generator) -> None:
    film = drawn_film(rng)
    matrix, size = drawn_place(rng)
    events = recorded_by(film.events, matrix, size, rng)
    begin = int(rng.integers(FRAMES - 4)) * PERIOD_US
    part = events.take((events.t >= begin) & (events.t < begin + 4 * PERIOD_US))
    place = found(film, part, size)
    assert place is not None and place.doubt
    agreeing = replace(place, correlation=1.0, rival=0.0, halves_agree=True, lag_us=0.0)
    assert "too few of the pictures' changes" in agreeing.doubt


def test_nothing_is_found_where_nothing_moves_or_no_event_came(rng: np.random.Generator) -> None:
    film = filmed_swing(int(rng.integers(1_000_000)))
    still = replace(film, pictures=film.pictures[:1] * FRAMES)
    matrix, size = drawn_place(rng)
    events = recorded_by(film.events, matrix, size, rng)
    assert found(still, events, size) is None
    assert found(film, events.take(slice(0, 0)), size) is None
    assert found(replace(film, pictures=film.pictures[:1], spans_us=[(0, 9)]), events, size) is None


def test_events_are_gathered_by_pieces_at_times_of_the_frames(rng: np.random.Generator) -> None:
    film = filmed_swing(int(rng.integers(1_000_000)))
    seen = gathered_changes(film)
    offset = int(rng.integers(-(10**9), 10**9))
    given = replace(film.events, t=film.events.t - offset)
    cuts = [0, *np.sort(rng.integers(0, len(given), 5)).tolist(), len(given)]
    pieces = [given.take(slice(a, b)) for a, b in zip(cuts, cuts[1:], strict=False)]
    gathered_events = seen.events(pieces, offset)
    assert np.array_equal(gathered_events.t, film.events.t)
    assert np.array_equal(gathered_events.x, film.events.x)
    far = seen.events(pieces, offset + 10 * FRAMES * PERIOD_US)
    assert len(far) == 0


def test_pictures_that_no_pair_needs_are_not_asked_for(rng: np.random.Generator) -> None:
    spans_us = [(40_000 * index, 40_000 * index + 10_000) for index in range(400)]
    seen, asked = ChangesSeen(spans_us, "linear"), []
    for index, span_us in enumerate(spans_us):

        def picture(index: int = index) -> torch.Tensor:
            asked.append(index)
            return torch.from_numpy(rng.random((12, 16)))

        seen.add(picture, span_us)
    times = {span_us for one in seen.pairs for span_us in (one.before_us, one.after_us)}
    assert [spans_us[index] for index in asked] == sorted(times) and len(asked) < 100
