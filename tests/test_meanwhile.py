"""Work on a thread of its own: order, bounds, errors and interruptions."""

import threading

import pytest

from evsplat.meanwhile import meanwhile

PATIENCE_S = 20
"""An event that does not come in this time never comes."""


def test_the_caller_goes_on_while_work_is_done_in_the_order_of_the_calls():
    may_go_on, done = threading.Event(), []

    def work(number: int) -> None:
        assert may_go_on.wait(PATIENCE_S)  # else the caller waits for the work
        done.append((number, threading.current_thread() is threading.main_thread()))

    with meanwhile() as do:
        for number in range(5):
            do(work, number)
        may_go_on.set()
    assert done == [(number, False) for number in range(5)]


def test_a_caller_that_is_faster_waits_so_that_little_is_kept():
    handed_over, most_ahead, done = 0, 0, 0

    def work() -> None:
        nonlocal done, most_ahead
        threading.Event().wait(0.002)
        most_ahead = max(most_ahead, handed_over - done)
        done += 1

    with meanwhile() as do:
        for _ in range(40):
            do(work)
            handed_over += 1
    assert done == 40 and 2 <= most_ahead <= 10


@pytest.mark.parametrize("later_calls", [0, 1, 30])
def test_the_first_error_comes_out_of_a_later_call_or_of_the_end(later_calls):
    def work(number: int) -> None:
        raise OSError(f"no room for {number}")

    with pytest.raises(OSError, match="no room for 0"), meanwhile() as do:
        for number in range(1 + later_calls):
            do(work, number)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_what_was_handed_over_is_done_when_the_caller_is_stopped(stop):
    stopped, done = threading.Event(), []

    def work(number: int) -> None:
        assert stopped.wait(PATIENCE_S)
        done.append(number)

    with pytest.raises(stop), meanwhile() as do:
        for number in range(4):
            do(work, number)
        stopped.set()
        raise stop
    assert done == [0, 1, 2, 3]
