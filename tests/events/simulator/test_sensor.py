"""The compiled sensor against float64 and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from evsplat.events import SensorSettings, SensorSimulator

from .helpers import by_pixel, joined, moving_pattern, reference_events

CLEAN = SensorSettings()
FILTERED = SensorSettings(cutoff_hz=80.0, contrast_mismatch=0.1)


@pytest.mark.parametrize("seed", [0, 1])
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
def test_events_are_those_of_a_float64_sensor(settings: SensorSettings, seed: int) -> None:
    frames = moving_pattern(seed, 30)
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(300, 4_000, len(frames))).tolist()
    sensor = SensorSimulator(37, 24, settings, seed)
    stream = joined([sensor.step(f, t) for f, t in zip(frames, times, strict=True)])
    expected, close = reference_events(
        frames, times, settings, sensor.contrast_on, sensor.contrast_off
    )
    assert len(stream) > 2_000 and (np.diff(stream.t) >= 0).all()
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
