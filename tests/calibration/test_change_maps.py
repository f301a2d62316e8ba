"""What events about a pair of frames add up to."""

import numpy as np
import pytest

from evsplat.calibration import FramePair
from evsplat.calibration.change_maps import Told
from evsplat.events import ALWAYS, EventStream, Span

WIDTH, HEIGHT = 48, 36
TURN_US, RISE = 60_000, 1e-4
"""For so long all pixels grow brighter and darker by turns, by so many thresholds a us."""


def level(time_us: float) -> float:
    return RISE * (TURN_US - abs(time_us % (2 * TURN_US) - TURN_US))


def recorded(seed: int, *, late_us: int) -> EventStream:
    """Of ideal pixels, each with another level at first."""
    rng = np.random.default_rng(seed)
    reference = rng.uniform(-1, 1, (HEIGHT, WIDTH))
    events = []
    for time in range(-2 * TURN_US, 2 * TURN_US, 200):
        for sign in (1, -1):
            y, x = np.nonzero(sign * (level(time) - reference) >= 1)
            reference[y, x] += sign
            events.append((np.full(len(x), time + late_us), x, y, np.full(len(x), sign)))
    t, x, y, p = (np.concatenate(column) for column in zip(*events, strict=True))
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


def exposed(before_us: Span, after_us: Span, recorded_us: Span) -> FramePair:
    """Two pictures of which only the times matter."""
    usable = np.ones((HEIGHT, WIDTH), bool)
    return FramePair(before_us, after_us, np.zeros(usable.shape), usable, recorded_us)


@pytest.mark.parametrize("step", [1, 5])
def test_levels_are_told_without_lag_when_a_change_turns(
    rng: np.random.Generator, step: int
) -> None:
    # polarities alone would say a whole threshold too much: half of what is left above the last
    # event while it rises, and below it while it falls
    late_us = int(rng.integers(-50_000, 50_000))
    events = recorded(int(rng.integers(1_000_000)), late_us=late_us)
    # from two thresholds after a turn on, when every pixel has said so
    before, after = (int(rng.integers(22_000, 55_000)) + turn for turn in (0, TURN_US))
    pair = exposed((before, before + 4_000), (after - 4_000, after), ALWAYS)
    maps = Told(pair, events, 60_000, (WIDTH, HEIGHT), step).maps(np.array([late_us, 0.0]))
    assert maps.shape == (2, HEIGHT // step, WIDTH // step)
    change = level(after - 2_000) - level(before + 2_000)
    assert maps[0].mean() == pytest.approx(change, abs=0.1)


def test_events_that_may_not_be_read_tell_nothing() -> None:
    events = recorded(3, late_us=0)
    pair = exposed((0, 4_000), (50_000, 54_000), (10_000, 30_000))
    maps = Told(pair, events, 0, (WIDTH, HEIGHT), 1).maps(np.zeros(1))
    within = events.take((events.t >= 10_000) & (events.t < 30_000))
    alone = Told(pair, within, 0, (WIDTH, HEIGHT), 1).maps(np.zeros(1))
    assert maps.any() and np.array_equal(maps, alone)


def test_what_fills_no_square_is_cut_off() -> None:
    events = recorded(5, late_us=0)
    pair = exposed((30_000, 34_000), (80_000, 84_000), ALWAYS)
    size = WIDTH - 9, HEIGHT - 2  # events lie beyond the sensor, too
    maps = Told(pair, events, 0, size, 7).maps(np.zeros(1))
    single = Told(pair, events, 0, (WIDTH, HEIGHT), 1).maps(np.zeros(1))
    within = single[:, : size[1] // 7 * 7, : size[0] // 7 * 7]
    means = within.reshape(1, size[1] // 7, 7, size[0] // 7, 7).mean((2, 4))
    assert np.allclose(maps, means, atol=1e-5)
