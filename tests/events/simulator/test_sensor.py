"""The compiled sensor against a plain one in float64; what it refuses; what it repeats."""

import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from evsplat.compiled import native
from evsplat.errors import ConfigError, DataError
from evsplat.events import (
    PRESETS,
    SensorSettings,
    SensorSimulator,
    sensor_settings,
    simulate_events,
)
from evsplat.pictures import luminance

from ..formats.helpers import same
from .helpers import by_pixel, joined, moving_pattern, reference_events, run

CLEAN = SensorSettings()
FILTERED = SensorSettings(cutoff_hz=80.0, contrast_mismatch=0.1)


@pytest.fixture(params=native.levels() if native else [])
def level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Every SIMD level that this CPU has, in turn."""
    monkeypatch.setenv("EVSPLAT_ISA", request.param)
    return request.param


@pytest.mark.parametrize(
    "settings",
    [
        CLEAN,
        SensorSettings(contrast_on=0.15, contrast_off=0.3, contrast_mismatch=0.2),
        SensorSettings(response="lin-log", contrast_on=0.25),
        FILTERED,
        SensorSettings(refractory_us=1_500.0),
        replace(FILTERED, refractory_us=700.0, response="lin-log"),
    ],
)
def test_events_are_those_of_a_float64_sensor(settings: SensorSettings, level: str) -> None:
    seed = zlib.crc32(f"{settings}{level}".encode())
    frames = moving_pattern(seed, 20)
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(300, 4_000, len(frames))).tolist()
    sensor = SensorSimulator(37, 24, settings, seed)
    stream = run(sensor, frames, times)
    expected, close = reference_events(
        frames, times, settings, sensor.contrast_on, sensor.contrast_off
    )
    assert len(stream) > 1_000 and (np.diff(stream.t) >= 0).all()
    found = by_pixel(stream)
    assert close.mean() < 0.05
    for pixel, events in expected.items():
        got = found.get(pixel, [])
        if close[pixel]:
            assert abs(len(got) - len(events)) <= 1
            continue
        assert [p for _, p in got] == [p for _, p, _ in events]
        for (t, _), (true, _, blur) in zip(got, events, strict=True):
            assert -1 - blur < t - true < blur  # times are cut to whole microseconds


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.integers(1, 3_000_000))
def test_a_contrast_step_gives_evenly_spaced_events(before: float, after: float, us: int) -> None:
    before, after = np.float32(before), np.float32(after)
    sensor = SensorSimulator(1, 1, SensorSettings(contrast_on=0.21, contrast_off=0.13))
    stream = run(sensor, [np.full((1, 1), v) for v in (before, after)], [500, 500 + us])
    change = np.log(float(after) + 1e-3) - np.log(float(before) + 1e-3)
    threshold = 0.21 if change > 0 else 0.13
    crossings = abs(change) / threshold
    assume(abs(crossings - round(crossings)) > 1e-4)
    assert (stream.p == np.sign(change)).all() and len(stream) == int(crossings)
    exact = 500 + us * np.arange(1, len(stream) + 1) / crossings
    assert np.abs(stream.t - np.floor(exact)).max(initial=0) <= 1 + 1e-5 * us


def test_events_of_any_length_of_step_are_sorted_by_time_then_pixel() -> None:
    for step_us in (7, 2_047, 2_048, 40_000, 5_000_000):
        frames = moving_pattern(step_us, 3, 50, 61)
        stream = run(SensorSimulator(61, 50), frames, step_us * np.arange(3))
        place = stream.y.astype(np.int64) * 61 + stream.x
        order = np.lexsort((place, stream.t))
        boundary = stream.t == step_us  # an event on a picture may come from either side of it
        assert (np.diff(stream.t) >= 0).all() and stream.t.min() >= 0
        assert np.array_equal(order[~boundary], np.arange(len(stream))[~boundary])


@pytest.mark.parametrize("preset", PRESETS)
def test_seed_decides_and_threads_do_not(preset: str) -> None:
    frames = moving_pattern(3, 8, 190, 231)
    before = torch.get_num_threads()
    streams = []
    try:
        for seed, threads in ((5, 1), (5, 2), (5, 3), (6, 3)):
            torch.set_num_threads(threads)
            sensor = SensorSimulator(231, 190, PRESETS[preset], seed)
            streams.append(run(sensor, frames, 4_000 * np.arange(8)))
    finally:
        torch.set_num_threads(before)
    assert same(streams[0], streams[1]) and same(streams[0], streams[2])
    assert same(streams[0], streams[3]) == (preset == "clean")


def test_colour_is_seen_as_its_luminance() -> None:
    rng = np.random.default_rng(0)
    colour = [torch.from_numpy(rng.random((9, 14, 3), dtype=np.float32)) for _ in range(4)]
    times = [0, 700, 1_100, 9_000]
    shown = joined(simulate_events(zip(times, colour, strict=True), seed=3))
    grey = joined(simulate_events([(t, luminance(c)) for t, c in zip(times, colour, strict=True)]))
    assert len(shown) > 500 and same(shown, grey)


def test_pictures_that_cannot_be_used_leave_the_sensor_as_it_was() -> None:
    frames = moving_pattern(1, 3)
    settings = PRESETS["davis346"]
    expected = run(SensorSimulator(37, 24, settings), frames, [0, 900, 2_000])
    sensor = SensorSimulator(37, 24, settings)
    parts = [sensor.step(frames[0], 0), sensor.step(frames[1], 900)]
    for value in (np.nan, np.inf, -np.inf):
        spoilt = frames[2].copy()
        spoilt[23, 36] = value
        with pytest.raises(DataError, match="2000 us holds a value that is not finite"):
            sensor.step(spoilt, 2_000)
    with pytest.raises(DataError, match=r"shape \(24, 36\), expected luma of shape \(24, 37\)"):
        sensor.step(frames[2][:, :36], 2_000)
    for time_us in (900, 899, 900 + 2**31):
        with pytest.raises(DataError, match="expected a later time"):
            sensor.step(frames[2], time_us)
    assert same(joined([*parts, sensor.step(frames[2], 2_000)]), expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contrast_on": 0.0}, "contrast_on is 0.0; expected a number of at least 0.01"),
        ({"contrast_off": float("nan")}, "contrast_off is nan"),
        ({"shot_hz": -1.0}, "shot_hz is -1.0; expected a number of at least 0"),
        ({"hot_pixel_fraction": 1.5}, "within 0 and 1"),
        ({"response": "gamma"}, "expected one of log, lin-log"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sensor_settings("evk4", **changes)


def test_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ConfigError, match="'davis': expected one of clean, davis346"):
        sensor_settings("davis")
