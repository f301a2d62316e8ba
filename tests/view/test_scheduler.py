"""The drawing thread: the newest request is served, nobody is forgotten or waits for a picture."""

import itertools
import threading
import time

import pytest

from evsplat.view.scheduler import LEAST_S, RenderScheduler


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class RenderClient:
    def __init__(self, name="", served=None):
        self.name, self.wanted = name, None
        self.served = [] if served is None else served

    def request(self, now):
        return self.wanted(now) if callable(self.wanted) else self.wanted

    def render(self, request, *, draft):
        self.served.append((self.name, request, draft))


@pytest.fixture
def scheduler():
    return RenderScheduler(Clock())


def _run(scheduler, seconds):
    """Serve for some seconds of a clock that goes by only while the scheduler sleeps."""
    end = scheduler._clock.now + seconds
    while True:
        pause = scheduler.turn()
        if pause is None or scheduler._clock.now + pause > end:
            return
        scheduler._clock.now += max(pause, 1e-6)


def test_a_view_that_settles_is_drawn_roughly_then_sharply_and_then_rests(scheduler):
    client = RenderClient()
    scheduler.enter(client)
    assert scheduler.turn() is None
    client.wanted = "view"
    _run(scheduler, 10)
    assert client.served == [("", "view", True), ("", "view", False)]


def test_only_the_newest_wish_is_drawn(scheduler):
    client = RenderClient()
    scheduler.enter(client)
    for request in range(50):
        client.wanted = request
    scheduler.turn()
    assert client.served == [("", 49, True)]


def test_while_a_view_moves_it_is_never_drawn_sharply(scheduler):
    client = RenderClient()
    views = itertools.count()
    client.wanted = lambda now: next(views)
    scheduler.enter(client)
    _run(scheduler, 3)
    assert len(client.served) > 20
    assert all(draft for _, _, draft in client.served)


def test_pictures_of_one_client_come_no_faster_than_a_screen_shows_them(scheduler):
    client = RenderClient()
    client.wanted = lambda now: now
    scheduler.enter(client)
    _run(scheduler, 2)
    assert len(client.served) <= 2 / LEAST_S + 1


def test_clients_take_turns(scheduler):
    served = []
    first, second = RenderClient("a", served), RenderClient("b", served)
    for client in (first, second):
        client.wanted = lambda now: now
        scheduler.enter(client)
    _run(scheduler, 1)
    names = [name for name, _, _ in served]
    assert abs(names.count("a") - names.count("b")) <= 1


def test_a_client_that_left_is_not_served(scheduler):
    client = RenderClient()
    client.wanted = "view"
    scheduler.enter(client)
    scheduler.leave(client)
    _run(scheduler, 1)
    assert client.served == []


def test_new_parameters_are_drawn_anew(scheduler):
    client = RenderClient()
    client.wanted = "view"
    scheduler.enter(client)
    _run(scheduler, 1)
    scheduler.redraw()
    _run(scheduler, 1)
    assert [draft for _, _, draft in client.served] == [True, False, True, False]


def test_asking_never_waits_for_a_picture_and_a_bad_picture_ends_nothing(caplog):
    drawing, go_on = threading.Event(), threading.Event()

    class Slow(RenderClient):
        def render(self, request, *, draft):
            super().render(request, draft=draft)
            drawing.set()
            go_on.wait(10)
            if request == "bad":
                raise ValueError("no such picture")

    scheduler, client = RenderScheduler(), Slow()
    client.wanted = "bad"
    scheduler.start()
    scheduler.enter(client)
    assert drawing.wait(10)
    started = time.perf_counter()
    client.wanted = "good"
    scheduler.wake()
    scheduler.enter(RenderClient())
    assert time.perf_counter() - started < 0.5
    go_on.set()
    deadline = time.monotonic() + 10
    while ("", "good", False) not in client.served and time.monotonic() < deadline:
        time.sleep(0.01)
    scheduler.close()
    assert ("", "good", False) in client.served
    assert "could not be drawn" in caplog.text
