"""Offsets of any length between two clocks, of a light that wanders through the picture."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from evsplat.calibration import offset
from evsplat.calibration.brightness import level_steps
from evsplat.calibration.offset import (
    BlockChanges,
    OffsetEstimate,
    TooLong,
    estimate_offset,
    offsets_by_correlation,
)
from evsplat.events import EventStream, open_recording
from evsplat.pictures.files import to_unit_range
from evsplat.pictures.squares import square_means

HEIGHT, WIDTH = 24, 36
STEP_US, PERIOD_US, EXPOSURE_US = 1_000, 40_000, 25_000
THRESHOLD = 0.1
Y, X = np.mgrid[:HEIGHT, :WIDTH]


def path(seed: int, end_us: int, period_us: int | None = None) -> np.ndarray:
    """(T, 2) where the light is at each step: never twice alike, or with a period."""
    rng, times = np.random.default_rng(seed), np.arange(0, end_us, STEP_US)
    if period_us is not None:
        hertz, phase = np.array([1e6 / period_us]), np.zeros((2, 1))
    else:
        hertz, phase = rng.uniform(0.2, 1.5, 6), rng.uniform(0, 2 * np.pi, (2, 6))
    turns = 2 * np.pi * hertz * times[:, None] * 1e-6
    waves = np.stack([np.sin(turns + one).mean(1) for one in phase], axis=1)
    return np.array([HEIGHT, WIDTH]) * (0.5 + 0.45 * waves / np.abs(waves).max(0))


def logarithms(places: np.ndarray) -> np.ndarray:
    """(T, H, W) logarithm of light."""
    squares = [(Y - y) ** 2 + (X - x) ** 2 for y, x in places]
    return np.log(0.08 + 0.7 * np.exp(-np.array(squares) / 18))


def seen(
    light: np.ndarray,
    first: int,
    count: int,
    read: Callable[[np.ndarray], np.ndarray] = lambda frame: frame,
) -> BlockChanges:
    """The frames from one on, each the mean of the light in its exposure, as ``read`` by a chip."""
    levels = BlockChanges("linear")
    for start in range(first * PERIOD_US, (first + count) * PERIOD_US, PERIOD_US):
        part = light[start // STEP_US : (start + EXPOSURE_US) // STEP_US]
        image = torch.from_numpy(read(np.exp(part).mean(0))).float()
        levels.add(image, (start, start + EXPOSURE_US))
    return levels


def sent(light: np.ndarray, first_us: int = 0) -> EventStream:
    """An event at each whole threshold that a pixel passes since its last one."""
    level, steps = light[0].copy(), np.zeros((len(light) - 1, *light.shape[1:]), int)
    for step, now in zip(steps, light[1:], strict=True):
        step[:] = np.trunc((now - level) / THRESHOLD)
        level += THRESHOLD * step
    time, y, x = np.nonzero(steps)
    repeats = np.abs(steps[time, y, x])
    t = np.repeat(first_us + STEP_US * (time + 1), repeats)
    x, y, p = (np.repeat(values, repeats) for values in (x, y, np.sign(steps[time, y, x])))
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


def found(levels: BlockChanges, *events: EventStream) -> OffsetEstimate:
    estimate = estimate_offset(levels, events, (WIDTH, HEIGHT))
    assert estimate is not None
    return estimate


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("first", "count", "recorded"), [(0, 60, (0, 60)), (17, 20, (0, 60)), (0, 60, (11, 50))]
)
def test_an_offset_of_up_to_a_minute_is_found(seed, first, count, recorded) -> None:
    light = logarithms(path(seed, 60 * PERIOD_US))
    offset_us = int(np.random.default_rng(seed).integers(-60_000_000, 60_000_000))
    begin, end = (frame * PERIOD_US // STEP_US for frame in recorded)
    events = sent(light[begin:end], begin * STEP_US - offset_us)
    half = len(events) // 2
    pieces = events.take(slice(0, half)), events.take(slice(half, None))
    estimate = found(seen(light, first, count), *pieces)
    assert estimate.is_certain
    assert estimate.offset_us == pytest.approx(offset_us, abs=3_000)


def test_noise_of_one_sign_changes_little() -> None:
    light = logarithms(path(5, 40 * PERIOD_US))
    clean, rng = sent(light), np.random.default_rng(5)
    count = len(clean)
    extra = EventStream(
        rng.integers(clean.t[0], clean.t[-1], count),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        np.ones(count, np.int8),
    )
    both = [np.concatenate(pair) for pair in zip(*map(vars_of, (clean, extra)), strict=True)]
    noisy = EventStream(*both).take(np.argsort(both[0], kind="stable"))
    levels = seen(light, 0, 40)
    estimate = found(levels, noisy)
    assert estimate.is_certain and abs(estimate.offset_us) < 3_000
    assert estimate.correlation > found(levels, clean).correlation - 0.1


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_dark_places_does_not_outweigh_what_moves(seed) -> None:
    """As of a sensor that stores light: one step of 8 bits is a quarter of what is dark there."""
    light, rng = logarithms(path(seed, 60 * PERIOD_US)), np.random.default_rng(seed)
    events = sent(light)
    dark = np.where(X < WIDTH // 3, np.log(0.004), light)

    def read(frame: np.ndarray) -> np.ndarray:
        noisy = frame + rng.normal(0, 0.006, frame.shape)
        return np.round(255 * noisy.clip(0, 1)) / 255

    estimate = found(seen(dark, 0, 60, read), events.take(events.x >= WIDTH // 3))
    assert estimate.is_certain and estimate.correlation > 0.95
    assert abs(estimate.offset_us) < 3_000


def test_a_street_with_cars_is_on_the_clock_that_its_description_says(recordings_root) -> None:
    recording = open_recording(recordings_root / "davis346.aedat4")
    changes = BlockChanges("linear")
    for frame in recording.frames():
        changes.add(to_unit_range(frame.image), frame.exposure_us)
    estimate = estimate_offset(changes, recording.chunks(), (346, 260))
    assert estimate is not None and estimate.is_certain
    assert estimate.offset_us == pytest.approx(-5_000, abs=2_000)


@pytest.mark.parametrize("seed", range(3))
def test_levels_of_a_recording_in_pieces_are_those_of_the_whole(seed) -> None:
    rng = np.random.default_rng(seed)
    pixel, brighter = rng.integers(0, 5, 200), rng.random(200) < 0.5
    last = np.zeros(5)
    pieces = [
        level_steps(pixel[part], brighter[part], last)
        for part in (slice(0, 3), slice(3, 3), slice(3, 120), slice(120, None))
    ]
    assert (np.concatenate(pieces) == level_steps(pixel, brighter)).all()
    assert level_steps(np.array([4, 4, 1, 4]), np.array([1, 1, 0, 0]) > 0).tolist() == [
        1.5,
        1.0,
        -1.5,
        -2.0,
    ]


def vars_of(events: EventStream) -> tuple[np.ndarray, ...]:
    return events.t, events.x, events.y, events.p


def test_what_repeats_itself_has_no_certain_offset() -> None:
    light = logarithms(path(0, 60 * PERIOD_US, period_us=500_000))
    estimate = found(seen(light, 20, 20), sent(light))
    assert not estimate.is_certain
    assert estimate.rival == pytest.approx(estimate.correlation, rel=0.05)


@pytest.mark.parametrize("period_us", [300_000, 500_000])
def test_each_period_of_what_repeats_itself_is_likely(period_us) -> None:
    """And nothing between, which would only be the foot of a peak."""
    light = logarithms(path(0, 60 * PERIOD_US, period_us=period_us))
    levels, events, size = seen(light, 20, 20), sent(light), (WIDTH, HEIGHT)
    likely = offsets_by_correlation(levels, [events], size, 3)
    assert likely[0] == estimate_offset(levels, [events], size)
    offsets = np.array([one.offset_us for one in likely])
    assert np.abs(offsets - period_us * np.round(offsets / period_us)).max() < 3_000
    assert len({round(offset / period_us) for offset in offsets}) == 3
    correlations = [one.correlation for one in likely]
    assert correlations == sorted(correlations, reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_events_of_another_recording_have_none(seed) -> None:
    light, other = (logarithms(path(one, 60 * PERIOD_US)) for one in (seed, seed + 50))
    assert not found(seen(light, 0, 60), sent(other)).is_certain


def test_without_two_frames_events_or_change_nothing_is_found() -> None:
    light = logarithms(path(0, 10 * PERIOD_US))
    still, size = np.repeat(light[:1], len(light), axis=0), (WIDTH, HEIGHT)
    nothing = sent(still)
    assert len(nothing) == 0
    assert estimate_offset(seen(light, 0, 10), [nothing], size) is None
    assert estimate_offset(seen(light, 0, 1), [sent(light)], size) is None
    assert estimate_offset(seen(still, 0, 10), [sent(light)], size) is None


def test_a_recording_too_long_to_be_held_is_refused(monkeypatch) -> None:
    light = logarithms(path(0, 10 * PERIOD_US))
    monkeypatch.setattr(offset, "LONGEST_S", 0.3)
    with pytest.raises(TooLong, match="its events last longer than 0.3 s"):
        estimate_offset(seen(light, 0, 10), [sent(light)], (WIDTH, HEIGHT))


def test_blocks_of_pictures_that_were_made_smaller_are_those_of_the_sensor(
    rng: np.random.Generator,
) -> None:
    for _ in range(20):
        height, width = (int(side) for side in rng.integers(60, 400, 2))
        factor = int(rng.integers(1, 6))
        slope = rng.uniform(0.2, 1, 2) / (height, width)
        light = np.exp((slope[:, None] * np.mgrid[:height, :width].reshape(2, -1)).sum(0) - 3)
        image = np.stack([light, 0 * light + 0.8]).reshape(2, height, width)
        whole, small = BlockChanges("linear"), BlockChanges("linear", (width, height))
        for start, picture in enumerate(image):
            span_us = (start * PERIOD_US, start * PERIOD_US + EXPOSURE_US)
            whole.add(torch.from_numpy(picture), span_us)
            small.add(torch.from_numpy(square_means(picture, factor, np.float64)), span_us)
        (expected,), (found,) = whole.changes, small.changes
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() < 1.5 * factor * slope.sum()
