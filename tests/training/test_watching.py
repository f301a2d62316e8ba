"""Snapshots are made while someone watches, and only then; the files go with the training."""

import os

import pytest
import torch

from evsplat.training.checkpoint import load_checkpoint
from evsplat.training.watching import Showcase, newest_state, watch
from evsplat.training_sign import is_training, training_in

CLOCK = {"iteration": 1, "iterations": 9, "fraction": 0.1, "seconds": 1.0, "step_seconds": 1.0}
STATE = {"clock": CLOCK, "human_count": 4}


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def run(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    return tmp_path


def _train(showcase, clock, seconds, watcher=lambda: None, step=0.25):
    """Steps of a training that asks whether to show itself; returns when it did."""
    shown = []
    for _ in range(round(seconds / step)):
        clock.now += step
        watcher()
        showcase.show(lambda: shown.append(clock.now) or ({"a": torch.ones(2)}, STATE))
    return shown


def test_an_unwatched_training_shows_nothing(run):
    clock = Clock()
    with training_in(run), Showcase(run, clock).open() as showcase:
        assert is_training(run)
        assert _train(showcase, clock, 60) == []
        assert newest_state(run) is None
    assert not is_training(run)


def test_a_watcher_sees_a_snapshot_every_few_seconds_until_it_goes(run):
    clock = Clock()
    ticks = iter(range(1, 10_000))

    def watcher():
        os.utime(run / ".watch", (0, next(ticks)))  # on a machine with any other clock

    with training_in(run), Showcase(run, clock).open() as showcase:
        shown = _train(showcase, clock, 30, watcher)
        assert 7 <= len(shown) <= 11
        tensors, state = load_checkpoint(newest_state(run))
        assert torch.equal(tensors["a"], torch.ones(2)) and state == STATE
        later = _train(showcase, clock, 60)
        assert len(later) <= 4
        assert not later or later[-1] < shown[-1] + 15
    assert not list(run.glob("*.safetensors")) and not is_training(run)


def test_a_slow_disk_takes_no_more_than_its_share(run):
    clock = Clock()
    ticks = iter(range(1, 10_000))

    with training_in(run), Showcase(run, clock).open() as showcase:
        shown = []

        def slow():
            shown.append(clock.now)
            clock.now += 2.0
            return {"a": torch.ones(2)}, {}

        while clock.now < 1000:
            clock.now += 0.5
            os.utime(run / ".watch", (0, next(ticks)))
            showcase.show(slow)
    assert 4 <= len(shown) <= 6


def test_watching_a_finished_run_leaves_nothing_behind(run):
    watch(run)
    assert not is_training(run)
    assert [path.name for path in run.iterdir()] == ["checkpoints"]


def test_the_state_written_last_is_the_newest(run):
    old, new = run / "checkpoints" / "000100.safetensors", run / "snapshot.safetensors"
    for path, at in ((old, 10), (new, 20)):
        path.touch()
        os.utime(path, (at, at))
    assert newest_state(run) == new
    os.utime(old, (30, 30))
    assert newest_state(run) == old
