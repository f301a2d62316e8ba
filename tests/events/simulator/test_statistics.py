"""Rates, thresholds and time constants recovered from simulated events against what was asked."""

import math
import zlib
from collections import Counter

import numpy as np
import pytest
from scipy import stats

from evsplat.events import SensorSettings, SensorSimulator

from .helpers import by_pixel, constant, counts, run

FEW_SIGMA = 4.0
"""Deviations of a mean that seeds may give; a rate wrong by a few per cent shows."""


@pytest.mark.parametrize(("step_us", "seconds", "leak_hz"), [(10_000, 20, 2.0), (50, 3, 0.7)])
def test_leak_gives_regular_on_events_at_its_rate(step_us: int, seconds: int, leak_hz: float):
    settings = SensorSettings(leak_hz=leak_hz, contrast_mismatch=0.1)
    sensor = SensorSimulator(40, 25, settings, seed=step_us)
    stream = constant(sensor, 0.3, seconds, step_us)
    assert (stream.p == 1).all()
    # a start anywhere between two events: counts of a pixel differ by less than one
    expected = leak_hz * seconds
    assert counts(stream, sensor).mean() == pytest.approx(expected, abs=FEW_SIGMA * 0.5 / 1000**0.5)
    for events in by_pixel(stream).values():
        gaps = np.diff([t for t, _ in events])
        assert np.abs(gaps - 1e6 / leak_hz).max(initial=0) < 2 + 1e-4 * 1e6 / leak_hz


def test_leak_spread_is_in_decades_of_the_rate() -> None:
    sensor = SensorSimulator(60, 50, SensorSettings(leak_hz=8.0, leak_spread=0.1), seed=2)
    rate = counts(constant(sensor, 0.5, 30, 10_000), sensor) / 30
    assert np.abs(rate - sensor.leak_hz).max() < 1 / 30 + 1e-3
    logarithms = np.log10(rate)
    assert logarithms.mean() == pytest.approx(math.log10(8), abs=FEW_SIGMA * 0.1 / 3000**0.5)
    assert logarithms.std() == pytest.approx(0.1, rel=FEW_SIGMA / 6000**0.5)


@pytest.mark.parametrize("light", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("step_us", [500, 30_000])
def test_shot_noise_is_poisson_at_the_rate_of_the_light(light: float, step_us: int) -> None:
    sensor = SensorSimulator(50, 40, SensorSettings(shot_hz=9.0), seed=zlib.crc32(b"%d" % step_us))
    seconds = 3
    stream = constant(sensor, light, seconds, step_us)
    mean = 9.0 * (1 - 0.75 * light) * seconds
    per_pixel = counts(stream, sensor)
    pixels = per_pixel.size
    assert per_pixel.mean() == pytest.approx(mean, abs=FEW_SIGMA * (mean / pixels) ** 0.5)
    assert per_pixel.var() / per_pixel.mean() == pytest.approx(
        1, abs=FEW_SIGMA * (2 / pixels) ** 0.5
    )
    assert (stream.p > 0).mean() == pytest.approx(0.5, abs=FEW_SIGMA * 0.5 / len(stream) ** 0.5)
    # given their number, the times of a Poisson process are uniform, within a step too
    assert stats.kstest(stream.t, "uniform", (0, 1e6 * seconds)).pvalue > 1e-4
    assert stats.kstest(stream.t % step_us, "uniform", (-0.5, step_us)).pvalue > 1e-4
    gaps = np.concatenate([np.diff([t for t, _ in e]) for e in by_pixel(stream).values()])
    alternating = np.concatenate([np.diff([p for _, p in e]) for e in by_pixel(stream).values()])
    assert len(gaps) and np.abs(alternating != 0).mean() == pytest.approx(
        0.5, abs=FEW_SIGMA * 0.5 / len(gaps) ** 0.5
    )


def test_neighbouring_pixels_have_unrelated_noise() -> None:
    sensor = SensorSimulator(64, 64, SensorSettings(shot_hz=20.0), seed=8)
    stream = constant(sensor, 0.0, 2, 10_000)
    noise = counts(stream, sensor) - 40.0
    for shifted in (noise[1:] * noise[:-1], noise[:, 1:] * noise[:, :-1]):
        assert shifted.mean() / noise.var() == pytest.approx(0, abs=FEW_SIGMA / 64)


def test_hot_pixels_are_as_many_and_as_fast_as_asked() -> None:
    settings = SensorSettings(hot_pixel_fraction=0.05, hot_pixel_hz=100.0)
    sensor = SensorSimulator(80, 60, settings, seed=4)
    stream = constant(sensor, 0.2, 2, 5_000)
    per_pixel = counts(stream, sensor)
    assert np.array_equal(per_pixel > 0, sensor.hot_hz > 0)
    share = (per_pixel > 0).mean()
    assert share == pytest.approx(0.05, abs=FEW_SIGMA * (0.05 * 0.95 / 4800) ** 0.5)
    hot = per_pixel[per_pixel > 0]
    assert hot.mean() == pytest.approx(200, abs=FEW_SIGMA * (200 / len(hot)) ** 0.5)
    assert (stream.p > 0).mean() == pytest.approx(0.5, abs=FEW_SIGMA * 0.5 / len(stream) ** 0.5)


def test_noise_adds_to_the_signal_without_disturbing_it() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.random((30, 40), dtype=np.float32) for _ in range(40)]
    times = 5_000 * np.arange(40)
    clean = run(SensorSimulator(40, 30), frames, times)
    noisy = run(SensorSimulator(40, 30, SensorSettings(shot_hz=50.0), seed=3), frames, times)
    tally = _tally(noisy)
    for event, n in _tally(clean).items():
        tally[event] -= n
    assert min(tally.values()) == 0
    light = float(np.mean(frames[1:]))
    expected = 50 * (1 - 0.75 * light) * 0.195 * 1200
    assert sum(tally.values()) == pytest.approx(expected, abs=FEW_SIGMA * expected**0.5)


def _tally(stream) -> Counter[tuple[int, int, int, int]]:
    return Counter(zip(*(getattr(stream, name).tolist() for name in "txyp"), strict=True))


def test_thresholds_and_their_mismatch_come_back_from_the_events() -> None:
    settings = SensorSettings(contrast_on=0.3, contrast_off=0.2, contrast_mismatch=0.1)
    sensor = SensorSimulator(60, 50, settings, seed=11)
    low, high = 1e-3, 1.0
    swings = 40
    frames = [np.full((50, 60), high if k % 2 else low) for k in range(2 * swings + 1)]
    stream = run(sensor, frames, 1_000 * np.arange(len(frames)))
    travel = swings * math.log((high + 1e-3) / (low + 1e-3))
    for sign, asked, drawn in ((1, 0.3, sensor.contrast_on), (-1, 0.2, sensor.contrast_off)):
        only = stream.p == sign
        pixel = stream.y[only].astype(int) * 60 + stream.x[only]
        # hysteresis: each turn costs less than one threshold of either sign
        estimate = travel / np.bincount(pixel, minlength=3000)
        assert np.corrcoef(estimate, drawn.ravel())[0, 1] > 0.9
        assert estimate.mean() == pytest.approx(asked, rel=0.08)
        assert drawn.mean() == pytest.approx(asked, rel=FEW_SIGMA * 0.1 / 3000**0.5)
        assert drawn.std() == pytest.approx(0.1 * asked, rel=FEW_SIGMA / 6000**0.5)
    assert abs(np.corrcoef(sensor.contrast_on.ravel(), sensor.contrast_off.ravel())[0, 1]) < 0.08


def test_one_long_ramp_gives_each_threshold_to_within_one_event() -> None:
    settings = SensorSettings(contrast_on=0.05, contrast_mismatch=0.2, log_eps=1e-6)
    sensor = SensorSimulator(30, 20, settings, seed=6)
    frames = [np.full((20, 30), math.exp(x)) for x in np.linspace(-9, 0, 200)]
    per_pixel = counts(run(sensor, frames, 1_000 * np.arange(200)), sensor)
    travel = math.log((1 + 1e-6) / (math.exp(-9) + 1e-6))
    assert (travel / (per_pixel + 1) <= sensor.contrast_on * (1 + 1e-5)).all()
    assert (sensor.contrast_on <= travel / per_pixel * (1 + 1e-5)).all()


@pytest.mark.parametrize(
    "settings", [SensorSettings(), SensorSettings(shot_hz=200.0, leak_hz=20.0)]
)
def test_no_pixel_speaks_again_within_its_dead_time(settings: SensorSettings) -> None:
    dead = SensorSettings(**{**settings.to_dict(), "refractory_us": 3_000.0})
    rng = np.random.default_rng(1)
    frames = [rng.random((30, 40), dtype=np.float32) for _ in range(60)]
    stream = run(SensorSimulator(40, 30, dead, seed=2), frames, 2_500 * np.arange(60))
    gaps = np.concatenate([np.diff([t for t, _ in e]) for e in by_pixel(stream).values()])
    assert gaps.min() >= 2_999  # times are cut to whole microseconds
    assert np.quantile(gaps, 0.05) < 3_500  # and it does speak soon after


def test_dead_time_thins_noise_as_a_renewal_process() -> None:
    settings = SensorSettings(shot_hz=100.0, refractory_us=10_000.0)
    sensor = SensorSimulator(50, 40, settings, seed=5)
    stream = constant(sensor, 0.0, 4, 2_000)
    # mean gap of a Poisson process behind a dead time: 1 / rate + dead time
    rate = len(stream) / 2000 / 4
    assert rate == pytest.approx(1 / (1 / 100 + 0.01), rel=0.02)


@pytest.mark.parametrize("light", [0.05, 0.9])
def test_step_response_is_that_of_a_first_order_low_pass(light: float) -> None:
    settings = SensorSettings(cutoff_hz=40.0, contrast_on=0.05)
    tau_us = 1e6 / (2 * math.pi * 40.0 * (255 * light + 20) / 275)
    dark = light / 8
    change = math.log((light + 1e-3) / (dark + 1e-3))
    # the light jumps within a microsecond; then pictures at uneven times
    times = [0, 1, *(1 + np.cumsum(np.random.default_rng(0).integers(50, 400, 400))).tolist()]
    frames = [np.full((1, 1), dark)] + [np.full((1, 1), light)] * (len(times) - 1)
    stream = run(SensorSimulator(1, 1, settings), frames, times)
    reached = (1 - math.exp(-(times[-1] - 1) / tau_us)) * change
    assert len(stream) == math.floor(reached / 0.05)
    crossings = -tau_us * np.log1p(-0.05 * np.arange(1, len(stream) + 1) / change)
    # between pictures the response is drawn straight: late by at most its sagitta
    sagitta = 400**2 / 8 / tau_us
    assert (np.abs(stream.t - crossings) < 3 + sagitta * np.exp(400 / tau_us)).all()


@pytest.mark.parametrize("cutoff_hz", [3.0, 300.0])
def test_low_pass_does_not_depend_on_how_often_a_steady_ramp_is_looked_at(cutoff_hz: float) -> None:
    settings = SensorSettings(cutoff_hz=cutoff_hz, contrast_on=0.01)
    ends = []
    for pictures in (40, 4_000):
        # light so that the logarithm is a straight line, dim enough for one time constant
        light = np.exp(np.linspace(math.log(0.011), math.log(0.012), pictures)) - 1e-3
        frames = [np.full((1, 1), v) for v in light]
        stream = run(SensorSimulator(1, 1, settings), frames, np.linspace(0, 4e5, pictures))
        ends.append(stream.t)
    assert len(ends[0]) == len(ends[1]) > 0
    assert np.abs(ends[0] - ends[1]).max() < 1_500


def test_sine_at_the_cutoff_loses_three_decibels() -> None:
    cutoff, contrast = 50.0, 0.02
    settings = SensorSettings(cutoff_hz=cutoff, contrast_on=contrast, contrast_off=contrast)
    t_us = np.arange(0, 400_000, 100)
    swing = 0.5
    light = 0.9 * np.exp(swing * (np.sin(2 * np.pi * cutoff * t_us * 1e-6) - 1))
    frames = [np.full((1, 1), v) for v in light]
    stream = run(SensorSimulator(1, 1, settings), frames, t_us).between(200_000, 400_000)
    level = np.cumsum(np.where(stream.p > 0, contrast, -contrast))
    amplitude = (level.max() - level.min()) / 2
    # brightness changes over the period, and the bandwidth with it: gain between its extremes
    fast, slow = ((255 * v + 20) / 275 for v in (light.max(), light.min()))
    gains = [1 / math.hypot(1, 1 / share) for share in (slow, fast)]
    assert gains[0] * swing - contrast < amplitude < gains[1] * swing + contrast
