"""The period of lamps that flicker is found, and none of people, cameras and noise."""

from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.calibration import flicker_period_us
from evsplat.calibration.flicker import _STEP_US, _period_us
from evsplat.events import EventStore, EventStream, SensorSimulator, sensor_settings, write_events

HEIGHT, WIDTH = 20, 28
LENGTH_S, STEP_US = 0.6, 500


def recording(
    path: Path, seed: int, hertz: float, depth: float, *, sensor: str = "clean", sway_px: int = 0
) -> EventStore:
    """Events of a bright bar before a texture, in light that swings by ``depth``.

    ``sway_px``: the whole picture swings to and fro by so much, three times a second.
    """
    rng = np.random.default_rng(seed)
    texture = rng.uniform(0.1, 0.7, (HEIGHT, WIDTH + 60))
    camera = SensorSimulator(WIDTH, HEIGHT, sensor_settings(sensor), seed)
    parts = []
    for time in range(0, round(LENGTH_S * 1e6), STEP_US):
        at = 30 + round(sway_px * np.sin(2 * np.pi * 3 * time * 1e-6))
        picture = texture[:, at : at + WIDTH].copy()
        left = int(20 * time * 1e-6 / LENGTH_S)
        picture[4:16, left : left + 5] = 0.9
        picture *= 1 + depth * np.sin(2 * np.pi * hertz * time * 1e-6)
        parts.append(camera.step(torch.from_numpy(picture.astype(np.float32)), time))
    write_events(path, EventStream.joined(parts))
    return EventStore(path, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("hertz", "depth", "sensor"), [(100, 0.2, "clean"), (120, 0.3, "clean"), (100, 0.4, "evk4")]
)
@pytest.mark.parametrize("seed", range(2))
def test_the_period_of_a_lamp_is_found(tmp_path, seed, hertz, depth, sensor):
    events = recording(tmp_path / "events.h5", seed, hertz, depth, sensor=sensor)
    assert flicker_period_us(events) == pytest.approx(1e6 / hertz, rel=0.01)
    # What is held out is not asked for, and what is left in between is enough.
    parts = events.restricted_to([(0, 150_000), (300_000, 420_000)])
    assert flicker_period_us(parts) == pytest.approx(1e6 / hertz, rel=0.02)


@pytest.mark.parametrize(("sensor", "sway_px"), [("clean", 0), ("davis346", 0), ("clean", 25)])
@pytest.mark.parametrize("seed", range(2))
def test_what_moves_does_not_flicker(tmp_path, seed, sensor, sway_px):
    events = recording(tmp_path / "events.h5", seed, 1, 0.0, sensor=sensor, sway_px=sway_px)
    assert len(events) > 500
    assert flicker_period_us(events) is None


def test_a_lamp_in_the_picture_is_not_all_light(tmp_path):
    """A quarter of the pixels sees a screen; the others see the room as it is."""
    whole = recording(tmp_path / "events.h5", 0, 100, 0.3)
    events = whole.between(*whole.time_range_us)
    write_events(tmp_path / "part.h5", events.take((events.x < WIDTH // 2) & (events.y < 10)))
    assert flicker_period_us(whole) is not None
    assert flicker_period_us(EventStore(tmp_path / "part.h5", WIDTH, HEIGHT)) is None


def test_nothing_is_found_in_too_little(tmp_path):
    whole = recording(tmp_path / "events.h5", 0, 100, 0.3)
    assert flicker_period_us(whole, (0, 40_000)) is None
    write_events(tmp_path / "few.h5", whole.between(0, 3_000))
    assert flicker_period_us(EventStore(tmp_path / "few.h5", WIDTH, HEIGHT)) is None
    no_signs = whole.between(*whole.time_range_us)
    blind = EventStream(no_signs.t, no_signs.x, no_signs.y, 0 * no_signs.p)
    write_events(tmp_path / "blind.h5", blind)
    assert flicker_period_us(EventStore(tmp_path / "blind.h5", WIDTH, HEIGHT)) is None


@pytest.mark.parametrize("second", [0.95, 1.15])
def test_of_several_periods_the_first_is_told_though_the_next_fits_a_little_better(second):
    """A signal that is like itself after 20.5 steps, after twice as many, and a little before."""
    lags = np.arange(80)
    alike = 10 * np.cos(2 * np.pi * lags / 20.5)
    alike[31:52] *= second
    alike[13:16] = 3, 6, 3
    assert _period_us(alike) == pytest.approx(20.5 * _STEP_US, rel=0.01)


def test_a_signal_that_comes_again_hardly_has_no_period():
    lags = np.arange(80)
    assert _period_us(np.cos(2 * np.pi * lags / 20.5) * np.exp(-lags / 4)) is None
    assert _period_us(np.exp(-lags / 4)) is None
