"""The render thread draws the newest requests in turn; drafts have the size that time allows."""

import itertools
import threading
import time

import pytest

from evsplat.view.scheduler import MIN_INTERVAL_S, MIN_SCALE, DraftResolution, RenderScheduler


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Client:
    def __init__(self, name="", drawn=None):
        self.name, self.wanted = name, "view"
        self.drawn = [] if drawn is None else drawn

    def request(self, now):
        return self.wanted(now) if callable(self.wanted) else self.wanted

    def render(self, request, *, draft):
        self.drawn.append((self.name, request, draft))


@pytest.fixture
def scheduler():
    return RenderScheduler(Clock())


def _run(scheduler, seconds):
    """Draw for some seconds of a clock that goes by only while the scheduler sleeps."""
    end = scheduler._clock.now + seconds
    while True:
        pause = scheduler.step()
        if pause is None or scheduler._clock.now + pause > end:
            return
        scheduler._clock.now += max(pause, 1e-6)


def test_a_view_that_settles_is_drawn_roughly_then_sharply_and_then_rests(scheduler):
    client = Client()
    assert scheduler.step() is None
    scheduler.add(client)
    _run(scheduler, 10)
    assert client.drawn == [("", "view", True), ("", "view", False)]


def test_only_the_newest_request_is_drawn(scheduler):
    client = Client()
    scheduler.add(client)
    for request in range(50):
        client.wanted = request
    scheduler.step()
    assert client.drawn == [("", 49, True)]


def test_while_a_view_moves_it_is_never_drawn_sharply(scheduler):
    client = Client()
    views = itertools.count()
    client.wanted = lambda now: next(views)
    scheduler.add(client)
    _run(scheduler, 3)
    assert len(client.drawn) > 20
    assert all(draft for _, _, draft in client.drawn)


def test_pictures_of_one_client_come_no_faster_than_a_screen_shows_them(scheduler):
    client = Client()
    client.wanted = lambda now: now
    scheduler.add(client)
    _run(scheduler, 2)
    assert len(client.drawn) <= 2 / MIN_INTERVAL_S + 1


def test_clients_take_turns(scheduler):
    drawn = []
    first, second = Client("a", drawn), Client("b", drawn)
    for client in (first, second):
        client.wanted = lambda now: now
        scheduler.add(client)
    _run(scheduler, 1)
    names = [name for name, _, _ in drawn]
    assert abs(names.count("a") - names.count("b")) <= 1


def test_a_client_that_left_is_not_drawn(scheduler):
    client = Client()
    scheduler.add(client)
    scheduler.remove(client)
    _run(scheduler, 1)
    assert client.drawn == []


def test_new_parameters_are_drawn_anew(scheduler):
    client = Client()
    scheduler.add(client)
    _run(scheduler, 1)
    scheduler.redraw()
    _run(scheduler, 1)
    assert [draft for _, _, draft in client.drawn] == [True, False, True, False]


def test_asking_never_waits_for_a_picture_and_a_bad_picture_ends_nothing(caplog):
    drawing, go_on = threading.Event(), threading.Event()

    class SlowClient(Client):
        def render(self, request, *, draft):
            super().render(request, draft=draft)
            drawing.set()
            go_on.wait(10)
            if request == "bad":
                raise ValueError("no such picture")

    scheduler, client = RenderScheduler(), SlowClient()
    client.wanted = "bad"
    scheduler.start()
    scheduler.add(client)
    assert drawing.wait(10)
    started = time.perf_counter()
    client.wanted = "good"
    scheduler.notify()
    scheduler.add(Client())
    assert time.perf_counter() - started < 0.5
    go_on.set()
    deadline = time.monotonic() + 10
    while ("", "good", False) not in client.drawn and time.monotonic() < deadline:
        time.sleep(0.01)
    scheduler.close()
    assert ("", "good", False) in client.drawn
    assert "could not be drawn" in caplog.text


def test_a_job_that_fails_costs_a_line_and_leaves_the_others(caplog):
    scheduler, done = RenderScheduler(), []
    for job in (lambda: done.append(1), lambda: 1 // 0, lambda: done.append(2)):
        scheduler.submit(job)
    assert scheduler.step() == 0 and done == [1, 2]
    assert scheduler.step() is None
    (record,) = caplog.records
    assert "ZeroDivisionError" in record.getMessage() and record.exc_info is None


@pytest.mark.parametrize("fails", ["request", "render"])
def test_a_browser_that_cannot_be_drawn_takes_nothing_from_the_others(scheduler, caplog, fails):
    def broken(*_, **__):
        raise ValueError("no\nnumber")

    bad, good = Client("bad"), Client("good")
    setattr(bad, fails, broken)
    for client in (bad, good):
        scheduler.add(client)
    for request in range(20):
        good.wanted = request
        _run(scheduler, 0.5)
    assert [drawn for _, drawn, draft in good.drawn if not draft] == list(range(20))
    said = [record.getMessage() for record in caplog.records]
    assert said == ["A picture could not be drawn or saved (ValueError: no number)."]


def test_a_full_picture_that_failed_is_asked_for_again_after_a_while(scheduler):
    tried = []

    class FailsOnce(Client):
        def render(self, request, *, draft):
            tried.append((scheduler._clock.now, draft))
            if [draft for _, draft in tried].count(False) == 1 and not draft:
                raise MemoryError("no memory just now")
            super().render(request, draft=draft)

    client = FailsOnce()
    scheduler.add(client)
    _run(scheduler, 10)
    assert client.drawn == [("", "view", True), ("", "view", False)]
    (_, _), (failed, _), (again, _) = tried
    assert again - failed == pytest.approx(1.0)


@pytest.mark.parametrize("nanoseconds_per_pixel", [20, 100, 300])
def test_drafts_come_to_take_the_target(nanoseconds_per_pixel):
    resolution = DraftResolution(target_s=0.04)
    for _ in range(40):
        width, height = resolution.size(1024, 1024)
        seconds = width * height * nanoseconds_per_pixel * 1e-9
        resolution.record(seconds)
    # Sizes go in steps of a quarter of an octave of the side, half an octave of the pixels.
    assert resolution.scale == 1 or 0.04 / 1.8 < seconds < 0.04 * 1.8


def test_drafts_never_become_useless():
    resolution = DraftResolution()
    for _ in range(40):
        resolution.record(100.0)
    assert resolution.scale == MIN_SCALE
    assert resolution.size(100, 50) == (30, 16)
    for _ in range(40):
        resolution.record(1e-6)
    assert resolution.size(100, 50) == (100, 50)


def test_a_slow_picture_now_and_then_does_not_change_the_size():
    resolution = DraftResolution(target_s=0.04)
    sizes = set()
    for picture in range(60):
        sizes.add(resolution.size(512, 512))
        # A scene that has to be drawn anew takes three times as long.
        resolution.record(0.036 * resolution.scale**2 * (2 if picture % 20 == 0 else 1))
    assert len(sizes) <= 2
