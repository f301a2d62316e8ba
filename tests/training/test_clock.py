"""The clock: where a run stands in its schedule."""

import pytest

from evsplat.training.clock import Clock


def test_steps_alone_go_through_the_schedule_exactly():
    clock = Clock(iterations=7)
    seen = []
    while not clock.done:
        seen.append(clock.fraction)
        clock.advance(0.1)
    assert seen == [i / 7 for i in range(7)]
    assert clock.fraction == 1.0
    assert clock.expected_iterations == 7


def test_a_time_limit_shortens_the_schedule_to_fit():
    clock = Clock(iterations=10_000, max_seconds=100.0, shrink=True)
    while not clock.done and not clock.out_of_time:
        # Steps become three times slower on the way, as they do when the set grows.
        clock.advance(0.5 + clock.fraction)
    assert clock.fraction == pytest.approx(1.0, abs=0.02)
    assert 95.0 <= clock.seconds <= 102.0
    assert clock.iteration < 250


def test_a_generous_time_limit_changes_nothing():
    clock = Clock(iterations=100, max_seconds=1e6, shrink=True)
    while not clock.done and not clock.out_of_time:
        clock.advance(0.01)
    assert clock.iteration in (100, 101)


def test_given_iterations_are_kept_and_cut_off_by_the_time_limit():
    clock = Clock(iterations=100, max_seconds=1.25)
    while not clock.done and not clock.out_of_time:
        clock.advance(0.125)
    assert clock.iteration == 10
    assert clock.nominal == pytest.approx(1_500)


def test_a_finished_run_goes_on_by_more_steps():
    clock = Clock(iterations=60)
    while not clock.done:
        clock.advance(0.1)
    clock.go_by(200)
    assert clock.fraction == 60 / 200
    while not clock.done:
        clock.advance(0.1)
    assert clock.iteration == 200


def test_a_run_that_is_longer_than_its_new_schedule_is_finished():
    clock = Clock(iterations=60)
    while not clock.done:
        clock.advance(0.1)
    clock.go_by(50)
    assert clock.done and clock.fraction == 1.0


def test_the_rest_of_a_schedule_is_passed_in_as_few_steps_as_are_said():
    clock = Clock(iterations=200, may_end_early=True)
    for _ in range(100):
        clock.advance(0.1)
    assert clock.end_in(25) and clock.expected_iterations == 125
    seen = []
    while not clock.done:
        seen.append(clock.fraction)
        clock.advance(0.1)
    # evenly, and to the very end of all schedules
    assert seen == pytest.approx([0.5 + 0.02 * step for step in range(25)])
    assert clock.iteration == 125 and clock.fraction == 1.0
    clock.go_by(250)
    assert clock.fraction == 0.5 and not clock.may_end_early and not clock.ends_at


def test_a_schedule_with_fewer_steps_left_stays_as_it_is():
    clock = Clock(iterations=200, may_end_early=True, iteration=180, fraction=0.9)
    assert not clock.end_in(25) and not clock.ends_at


def test_a_run_that_was_to_fit_a_time_goes_on_from_where_it_stands_without_one(rng):
    """Its schedule is far ahead of its steps; what is left of it is passed evenly."""
    short = Clock(iterations=1_000, max_seconds=60.0, shrink=True)
    for _ in range(int(rng.integers(5, 50))):
        short.advance(1.0)
    kept = ("iteration", "fraction", "seconds", "step_seconds")
    clock = Clock(iterations=1_000, **{name: getattr(short, name) for name in kept})
    before, end = clock.fraction, clock.expected_iterations
    assert before > 2 * clock.iteration / clock.iterations
    while not clock.done:
        clock.advance(1.0)
        assert clock.done or clock.fraction - before == pytest.approx(1 / 1_000)
        before = clock.fraction
    assert clock.fraction == 1.0 and abs(clock.iteration - end) <= 1
