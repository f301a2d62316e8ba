"""A limit on time shortens schedules, and without one they are taken step by step."""

import pytest

from evsplat.posing import time_limit
from evsplat.posing.time_limit import TimeLimit


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [0.0]
    monkeypatch.setattr(time_limit.time, "monotonic", lambda: now[0])
    return now


def places(limit, count, clock, step_s, size=1):
    """Places in the schedule of a descent whose steps take so long."""
    found = []
    for place in limit.steps(count, size):
        found.append(place)
        clock[0] += step_s
    return found


def test_without_a_limit_all_steps_are_taken(clock):
    assert places(TimeLimit(None, 4), 4, clock, 1e9) == [0, 0.25, 0.5, 0.75]


def test_a_limit_that_is_not_reached_changes_nothing(clock):
    assert places(TimeLimit(4.0, 4), 4, clock, 0.5) == [0, 0.25, 0.5, 0.75]


def test_descents_share_the_time_and_what_one_leaves_goes_to_the_next(clock):
    limit = TimeLimit(8.0, 128)
    assert len(places(limit, 32, clock, 0.25)) == 8  # 2 of 8 s
    assert len(places(limit, 32, clock, 1 / 32)) == 32  # 1 of 2 s
    assert len(places(limit, 4, clock, 0.5)) == 1  # 0.3 of 5 s
    assert len(places(limit, 7, clock, 0.5, size=4)) == 5  # 2.1 of 4.5 s
    assert len(places(limit, 32, clock, 0.25)) == 8


def test_without_time_one_step_is_taken_of_each(clock):
    limit = TimeLimit(0.0, 10)
    assert [len(places(limit, 5, clock, 1.0)) for _ in range(2)] == [1, 1]


def test_the_bar_is_never_fuller_than_full(clock):
    for count in range(1, 60):
        limit = TimeLimit(None, 3 * count, progress=True)
        for _ in range(3):
            places(limit, count, clock, 1.0)
        assert limit._bar.n <= limit._bar.total
        assert limit._bar.n == pytest.approx(limit._bar.total)
        limit.close()
