"""The drawing thread: the newest wish is served, nobody is forgotten or waits for a picture."""

import itertools
import threading
import time

import pytest

from evsplat.view.desk import LEAST_S, Desk


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Customer:
    def __init__(self, name="", served=None):
        self.name, self.wanted = name, None
        self.served = [] if served is None else served

    def wish(self, now):
        return self.wanted(now) if callable(self.wanted) else self.wanted

    def serve(self, wish, *, draft):
        self.served.append((self.name, wish, draft))


@pytest.fixture
def desk():
    return Desk(Clock())


def _run(desk, seconds):
    """Serve for some seconds of a clock that goes by only while the desk sleeps."""
    end = desk._clock.now + seconds
    while True:
        pause = desk.turn()
        if pause is None or desk._clock.now + pause > end:
            return
        desk._clock.now += max(pause, 1e-6)


def test_a_view_that_settles_is_drawn_roughly_then_sharply_and_then_rests(desk):
    customer = Customer()
    desk.enter(customer)
    assert desk.turn() is None
    customer.wanted = "view"
    _run(desk, 10)
    assert customer.served == [("", "view", True), ("", "view", False)]


def test_only_the_newest_wish_is_drawn(desk):
    customer = Customer()
    desk.enter(customer)
    for wish in range(50):
        customer.wanted = wish
    desk.turn()
    assert customer.served == [("", 49, True)]


def test_while_a_view_moves_it_is_never_drawn_sharply(desk):
    customer = Customer()
    views = itertools.count()
    customer.wanted = lambda now: next(views)
    desk.enter(customer)
    _run(desk, 3)
    assert len(customer.served) > 20
    assert all(draft for _, _, draft in customer.served)


def test_pictures_of_one_client_come_no_faster_than_a_screen_shows_them(desk):
    customer = Customer()
    customer.wanted = lambda now: now
    desk.enter(customer)
    _run(desk, 2)
    assert len(customer.served) <= 2 / LEAST_S + 1


def test_clients_take_turns(desk):
    served = []
    first, second = Customer("a", served), Customer("b", served)
    for customer in (first, second):
        customer.wanted = lambda now: now
        desk.enter(customer)
    _run(desk, 1)
    names = [name for name, _, _ in served]
    assert abs(names.count("a") - names.count("b")) <= 1


def test_a_client_that_left_is_not_served(desk):
    customer = Customer()
    customer.wanted = "view"
    desk.enter(customer)
    desk.leave(customer)
    _run(desk, 1)
    assert customer.served == []


def test_new_parameters_are_drawn_anew(desk):
    customer = Customer()
    customer.wanted = "view"
    desk.enter(customer)
    _run(desk, 1)
    desk.redraw()
    _run(desk, 1)
    assert [draft for _, _, draft in customer.served] == [True, False, True, False]


def test_asking_never_waits_for_a_picture_and_a_bad_picture_ends_nothing(caplog):
    drawing, go_on = threading.Event(), threading.Event()

    class Slow(Customer):
        def serve(self, wish, *, draft):
            super().serve(wish, draft=draft)
            drawing.set()
            go_on.wait(10)
            if wish == "bad":
                raise ValueError("no such picture")

    desk, customer = Desk(), Slow()
    customer.wanted = "bad"
    desk.start()
    desk.enter(customer)
    assert drawing.wait(10)
    started = time.perf_counter()
    customer.wanted = "good"
    desk.wake()
    desk.enter(Customer())
    assert time.perf_counter() - started < 0.5
    go_on.set()
    deadline = time.monotonic() + 10
    while ("", "good", False) not in customer.served and time.monotonic() < deadline:
        time.sleep(0.01)
    desk.close()
    assert ("", "good", False) in customer.served
    assert "could not be drawn" in caplog.text
