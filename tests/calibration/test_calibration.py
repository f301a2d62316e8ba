"""Clock lag, thresholds and noise of recordings for which they are known."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.calibration import (
    NoiseMeter,
    SensorEstimate,
    estimate_from_pairs,
    estimate_thresholds,
    exposure,
    noise_of,
    pair,
    pair_indices,
)
from evsplat.capture import estimate_sensor
from evsplat.errors import DataError
from evsplat.events import ALWAYS, EventStream, open_recording
from evsplat.inspection.sensor import sensor_lines

from ..seen import seen
from .synthetic import record

Factory = Callable[..., Path]


def _estimate(seed: int, **options) -> SensorEstimate:
    recording = record(seed, **options)
    found = estimate_from_pairs(recording.pairs, recording.events)
    assert found is not None and found.thresholds is not None
    return found


@pytest.mark.parametrize(
    ("seed", "lag_us", "plus", "minus"),
    [(0, 0, 0.2, 0.2), (1, 7_000, 0.3, 0.2), (2, -13_000, 0.15, 0.25), (3, 55_000, 0.2, 0.3)],
)
def test_known_lag_and_thresholds_are_found(seed, lag_us, plus, minus) -> None:
    found = _estimate(seed, plus=plus, minus=minus, lag_us=lag_us)
    # An event tells of a change when a whole threshold is passed: some of that delay stays.
    assert abs(found.clock.lag_us - lag_us) < 2_500
    assert found.thresholds.plus == pytest.approx(plus, rel=0.08)
    assert found.thresholds.minus == pytest.approx(minus, rel=0.08)
    assert found.clock.correlation > 0.95
    assert found.clock.spread_us < 200


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_pair_of_frames_leaves_doubt_of_the_clock(seed) -> None:
    recording = record(seed, plus=0.2, minus=0.2, lag_us=30_000)
    of_all = estimate_from_pairs(recording.pairs, recording.events)
    of_one = estimate_from_pairs(recording.pairs[:1], recording.events)
    assert of_all is not None and of_all.clock.differs
    assert of_one is not None and not of_one.clock.differs
    line = sensor_lines(of_one, 0, has_polarity=True)[0]
    assert "too little moves" in line and "nan" not in line


@pytest.mark.parametrize("noise_hz", [0.0, 10.0])
@pytest.mark.parametrize("seed", np.random.SeedSequence().generate_state(2))
def test_a_step_in_a_still_recording_leaves_doubt_of_the_clock(seed, noise_hz) -> None:
    """The error was that of leaving out pairs of noise alone, which changes nothing."""
    noisy = {"noise_hz": noise_hz, "frame_noise": 0.003 if noise_hz else 0.0}
    options = {"plus": 0.2, "minus": 0.2, "lag_us": 6_000, "frames": 40} | noisy
    step = record(seed, moving_frames=2, **options)  # whose thresholds may not be told
    found = estimate_from_pairs(step.pairs, step.events)
    assert found is not None
    of_a_step = found.clock
    assert np.isnan(of_a_step.spread_us) and not of_a_step.differs
    of_a_while = _estimate(seed, moving_frames=8, **options).clock
    assert 5 < of_a_while.spread_us < 500 and of_a_while.differs


@pytest.mark.parametrize("seed", [4, 5])
def test_noise_of_frames_and_events_moves_the_estimates_little(seed) -> None:
    found = _estimate(seed, plus=0.25, minus=0.2, lag_us=5_000, frame_noise=0.01, noise_hz=1.0)
    assert abs(found.clock.lag_us - 5_000) < 2_500
    assert found.thresholds.plus == pytest.approx(0.25, rel=0.1)
    assert found.thresholds.minus == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("frame_noise", [0.0, 0.002])
@pytest.mark.parametrize(("plus", "minus"), [(0.36, 0.4), (0.2, 0.25)])
def test_noise_where_nothing_moves_is_no_lower_threshold(plus, minus, frame_noise) -> None:
    """Of the pixels with events most saw none but the noise's, and did not change."""
    noisy = {"still_rows": 19, "noise_hz": 4.0, "frame_noise": frame_noise}
    found = _estimate(3, plus=plus, minus=minus, frames=30, **noisy)
    assert found.thresholds.plus == pytest.approx(plus, rel=0.1)
    assert found.thresholds.minus == pytest.approx(minus, rel=0.1)


def test_a_sensor_whose_pixels_fire_once_has_thresholds_as_well() -> None:
    found = _estimate(5, plus=0.9, minus=0.9, frames=40)
    assert found.thresholds.plus == pytest.approx(0.9, rel=0.2)
    assert found.thresholds.minus == pytest.approx(0.9, rel=0.2)


def test_what_noise_alone_tells_is_no_threshold() -> None:
    """All that moves is in too few pixels to fit to, and the rest has no change."""
    still = record(7, plus=0.3, minus=0.3, frames=40, still_rows=24, noise_hz=10.0)
    assert estimate_thresholds(still.pairs, still.events) is None


@pytest.mark.parametrize("seed", [6, 7])
def test_long_exposures_are_accounted_for(seed) -> None:
    found = _estimate(seed, plus=0.2, minus=0.2, lag_us=4_000, exposure_us=32_000)
    assert abs(found.clock.lag_us - 4_000) < 2_500
    assert found.thresholds.plus == pytest.approx(0.2, rel=0.1)
    assert found.thresholds.minus == pytest.approx(0.2, rel=0.1)


def test_unrelated_events_give_no_estimate() -> None:
    ours = record(0, plus=0.2, minus=0.2)
    others = record(1, plus=0.2, minus=0.2)
    assert estimate_from_pairs(ours.pairs, others.events) is None


def test_stillness_gives_no_estimate() -> None:
    ours = record(0, plus=0.2, minus=0.2)
    nothing = EventStream(*(np.zeros(0, dtype=kind) for kind in ("i8", "u2", "u2", "i1")))
    assert estimate_from_pairs(ours.pairs, nothing) is None
    assert estimate_from_pairs([], ours.events) is None


def test_shifting_the_events_of_a_capture_shifts_the_estimate(tiny_capture: Factory) -> None:
    """``clock_offset_us`` is added to the events' times: a positive one makes them lag."""
    options = {"frames": 20, "width": 96, "height": 72}
    path = tiny_capture(**options)
    before = estimate_sensor(seen(path))
    document = json.loads((path / "capture.json").read_text())
    document["events"]["clock_offset_us"] = 9_000
    (path / "capture.json").write_text(json.dumps(document))
    after = estimate_sensor(seen(path))
    assert before is not None and after is not None
    assert abs(before.clock.lag_us) < 3_000
    assert after.clock.lag_us - before.clock.lag_us == pytest.approx(9_000, abs=800)


def test_a_capture_without_events_gives_no_estimate(tiny_capture: Factory) -> None:
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    del document["events"]
    (path / "capture.json").write_text(json.dumps(document))
    assert estimate_sensor(seen(path)) is None


def test_pairs_skip_frames_that_follow_each_other_too_fast() -> None:
    spans = [(1_000 * k, 1_000 * k + 100) for k in range(50)]
    pairs = pair_indices(spans, 1_000)
    assert {j - i for i, j in pairs} == {20} and len(pairs) == 30
    assert pair_indices([(40_000 * k, 40_000 * k + 100) for k in range(4)], 10) == [
        (0, 1),
        (1, 2),
        (2, 3),
    ]
    assert len(pair_indices(spans, 7)) == 7
    assert pair_indices(spans[:1], 7) == []


def test_frames_of_different_size_are_refused() -> None:
    small, large = (exposure(torch.full((size, 4), 0.5), (0, 10)) for size in (3, 5))
    with pytest.raises(DataError, match="4, 3.*4, 5"):
        pair(small, large, ALWAYS)


@pytest.mark.parametrize("seed", range(3))
def test_noise_rate_hot_pixels_and_polarity_are_found_beside_motion(seed) -> None:
    rng = np.random.default_rng(seed)
    width, height, duration, rate = 80, 60, 20_000_000, 0.03
    count = rng.poisson(rate * width * height * duration * 1e-6)
    quiet = np.stack(
        [
            rng.integers(0, duration, count),
            rng.integers(0, width, count),
            rng.integers(0, height, count),
            np.where(rng.random(count) < 0.9, 1, -1),
        ]
    )
    # An edge sweeps over the left third again and again.
    sweeps = np.array(
        [
            (k * 50_000 + 900 * x + y, x, y, 1)
            for k in range(400)
            for x in range(26)
            for y in range(60)
        ]
    ).T
    hot = np.stack([np.arange(0, duration, 40_000), *([value] * 500 for value in (70, 31, 1))])
    columns = np.concatenate([quiet, sweeps, hot], axis=1)
    t, x, y, p = columns[:, np.argsort(columns[0], kind="stable")]
    stream = EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))
    meter = NoiseMeter(width, height)
    for k in range(4):
        meter.add(stream.between(k * 5_000_000, (k + 1) * 5_000_000))
    assert meter.total.sum() == len(stream)
    found = meter.estimate(duration)
    assert found.rate_hz == pytest.approx(rate, rel=0.1)
    assert found.brighter_share == pytest.approx(0.9, abs=0.05)
    assert found.hot_pixels.tolist() == [[70, 31]]


def test_a_picture_that_moves_everywhere_has_no_noise_estimate() -> None:
    t = np.repeat(np.arange(100), 48) * 1_000
    pixel = np.tile(np.arange(48), 100)
    stream = EventStream(
        t,
        (pixel % 8).astype(np.uint16),
        (pixel // 8).astype(np.uint16),
        np.ones(4_800, dtype=np.int8),
    )
    meter = NoiseMeter(8, 6)
    meter.add(stream)
    assert meter.estimate(100_000).rate_hz is None


def test_the_davis_recording_gives_the_known_figures(recordings_root: Path) -> None:
    """Measured before by other means: events 5 ms late, C+ 0.36, C- 0.40, correlation 0.90."""
    recording = open_recording(recordings_root / "davis346.aedat4")
    frames = list(recording.frames())
    spans = [frame.exposure_us for frame in frames]
    pictures = [
        exposure(
            torch.from_numpy(frame.image.astype(np.float32) / 255),
            frame.exposure_us,
            transfer="linear",
        )
        for frame in frames
    ]
    events = recording.read()
    recorded = int(events.t[0]), int(events.t[-1]) + 1
    pairs = [pair(pictures[i], pictures[j], recorded) for i, j in pair_indices(spans, 60)]
    found = estimate_from_pairs(pairs, events)
    assert found is not None and found.thresholds is not None
    assert found.clock.correlation >= 0.85
    assert abs(found.clock.lag_us - 5_000) < 2_000
    assert found.thresholds.plus == pytest.approx(0.36, rel=0.1)
    assert found.thresholds.minus == pytest.approx(0.40, rel=0.1)
    meter = NoiseMeter(346, 260)
    meter.add(events)
    noise = meter.estimate(recorded[1] - recorded[0])
    assert noise.rate_hz == pytest.approx(0.003, rel=0.3)
    assert noise.brighter_share > 0.9


@pytest.mark.parametrize("name", ["man_dance_hard_256", "real_beam_256"])
def test_simulated_events_of_shared_captures_lag_little(captures_root: Path, name: str) -> None:
    found = estimate_sensor(seen(captures_root / name, use="everything"))
    assert found is not None and found.thresholds is not None
    assert abs(found.clock.lag_us) < 1_500
    assert found.thresholds.plus == pytest.approx(0.2, rel=0.15)
    assert found.thresholds.minus == pytest.approx(0.2, rel=0.15)


class LongRecording:
    """An hour of background activity and a hot pixel, made when it is asked for."""

    width, height, rate_hz, hour_us = 40, 30, 40, 3_600_000_000
    stretches_us = ((0, hour_us // 2), (hour_us // 2 + 1_000, hour_us))

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return self.rate_hz * self.width * self.height * 3_600

    def between(self, start: int, end: int) -> EventStream:
        assert any(low <= start < end <= high for low, high in self.stretches_us)
        self.asked.append((start, end))
        rng = np.random.default_rng(start % 2**32)
        count = rng.poisson(self.rate_hz * self.width * self.height * (end - start) / 1e6)
        hot = int(900 * (end - start) / 1e6)
        t = np.sort(rng.integers(start, end, count + hot))
        place = np.concatenate([rng.integers(0, self.width * self.height, count), np.full(hot, 77)])
        y, x = np.divmod(rng.permutation(place), self.width)
        p = rng.choice([-1, 1], len(t))
        return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


@pytest.mark.parametrize(
    ("during_us", "most", "pieces"), [(None, 10**9, 60), ((10**9, 10**9 + 9 * 10**6), 10**5, 9)]
)
def test_noise_of_an_hour_is_that_of_sixty_pieces(monkeypatch, during_us, most, pieces) -> None:
    monkeypatch.setattr("evsplat.calibration.noise._MOST_EVENTS", most)
    recording = LongRecording()
    found = noise_of(recording, *([during_us] if during_us else []))
    assert len(recording.asked) == pieces
    start, end = during_us or (0, recording.hour_us)
    assert all(start <= first < last <= end for first, last in recording.asked)
    seconds = sum(last - first for first, last in recording.asked) / 1e6
    assert seconds * recording.rate_hz * recording.width * recording.height < 1.2 * most
    assert found.background_hz == pytest.approx(recording.rate_hz, rel=0.1)
    assert found.hot_pixels.tolist() == [[77 - 40, 1]]
