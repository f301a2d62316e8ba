"""Playback: time that stands, moves at a speed and loops."""

import numpy as np
import pytest

from evsplat.view.request import Playback


@pytest.mark.parametrize("seed", range(4))
def test_a_hundredth_of_life_takes_a_hundred_times_as_long(seed):
    rng = np.random.default_rng(seed)
    start, now = rng.uniform(0, 1e6), rng.uniform(0, 1e3)
    exposure_us, speed = 72_000, 1 / 100
    playback = Playback(start, start + exposure_us, start, speed=speed).playing(True, now)
    half = exposure_us / 2 / 1e6 / speed
    assert playback.at(now + half) == pytest.approx(start + exposure_us / 2, abs=1)
    assert playback.at(now + 2.5 * half) == pytest.approx(start + exposure_us / 4, abs=1)


def test_what_stands_stays():
    playback = Playback(0, 1000, 300)
    assert playback.at(0) == playback.at(1e9) == 300


def test_a_change_of_speed_does_not_jump():
    playback = Playback(0, 1e6, 0).playing(True, 10)
    slower = playback.at_speed(0.1, 10.25)
    assert slower.at(10.25) == pytest.approx(250_000)
    assert slower.at(11.25) == pytest.approx(350_000)
    paused = slower.playing(False, 11.25)
    assert paused.at(99) == pytest.approx(350_000)


def test_another_loop_keeps_the_time_if_it_can():
    playback = Playback(0, 1e6, 400_000).playing(True, 0)
    assert playback.within(300_000, 500_000, 0.05).at(0.05) == pytest.approx(450_000)
    assert playback.within(600_000, 700_000, 0.05).at(0.05) == pytest.approx(600_000)


def test_a_recording_of_one_instant_can_be_played():
    assert Playback(5, 5, 5).playing(True, 0).at(3) == 5
