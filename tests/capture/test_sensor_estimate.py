"""The pairs of frames that clock, thresholds and the check of the events are found from."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from evsplat.calibration import (
    FramePair,
    Lost,
    exposure,
    find_lost,
    pair,
    pauses,
    untold_spans,
)
from evsplat.capture import (
    TrainingCapture,
    estimate_sensor,
    lost_events,
    sensor_estimate,
    shared_pairs,
)
from evsplat.capture.sensor_estimate import frame_pairs
from evsplat.inspection.event_check import event_findings
from evsplat.methods import TRAINABLE
from evsplat.pictures.files import read_image

from ..conftest import write_event_file
from ..seen import changes_much, seen
from ..small_model import small_config

Factory = Callable[..., Path]


@pytest.fixture
def capture(tiny_capture: Factory) -> TrainingCapture:
    return seen(tiny_capture(frames=12, width=40, height=32))


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often the brightness of each frame is found, by the start of its exposure."""
    counts: Counter[str] = Counter()

    def counted(image, span_us, **transfer):
        counts[str(span_us)] += 1
        return exposure(image, span_us, **transfer)

    monkeypatch.setattr(sensor_estimate, "exposure", counted)
    return counts


def _same(first: FramePair, second: FramePair) -> bool:
    return (
        np.array_equal(first.change, second.change)
        and np.array_equal(first.usable, second.usable)
        and (first.before_us, first.after_us, first.recorded_us)
        == (second.before_us, second.after_us, second.recorded_us)
    )


def test_pairs_are_of_frames_next_to_each_other_each_made_once(capture, asked) -> None:
    pairs = frame_pairs(capture)
    by_span = {frame.exposure_us: frame for frame in capture.train_frames}
    assert len(pairs) > 3
    for found in pairs:
        before, after = (by_span[span] for span in (found.before_us, found.after_us))
        assert capture.frames[before.index + 1].name == after.name
        alone = [
            exposure(capture.image(one), one.exposure_us, transfer=capture.transfer(one))
            for one in (before, after)
        ]
        assert _same(found, pair(*alone, found.recorded_us))
    assert set(asked.values()) == {1}


def test_the_check_and_the_estimate_share_their_pairs_and_find_what_each_finds_alone(
    capture, asked
) -> None:
    findings, estimate = event_findings(capture), estimate_sensor(capture)
    alone = asked.copy()
    asked.clear()
    with shared_pairs(capture):
        assert event_findings(capture) == findings
        shared = estimate_sensor(capture)
    assert estimate is not None and shared is not None
    np.testing.assert_equal(asdict(shared), asdict(estimate))
    assert 2 * asked.total() == alone.total() > 0


def _cut(path: Path, start_us: int, end_us: int) -> None:
    """Leave out the events between two times."""
    with h5py.File(path / "events.h5") as file:
        columns = [file[f"events/{key}"][:] for key in "txyp"]
    kept = (columns[0] < start_us) | (columns[0] >= end_us)
    write_event_file(path / "events.h5", *(column[kept] for column in columns))


@pytest.fixture
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """As few of the frames are compared as of a long recording."""
    monkeypatch.setattr(sensor_estimate, "MOST_PAIRS", 2)


def test_a_stall_between_the_pairs_that_are_compared_is_found_once(
    rng: np.random.Generator, tiny_capture: Factory, few_pairs, monkeypatch
) -> None:
    # Frames are 40 ms apart; those of 10 to 16 and 20 to 26 train.
    drawn = (
        (tiny_capture(str(seed), frames=30, width=96, height=72, seed=int(seed)), int(first))
        for seed, first in zip(
            rng.integers(10_000, size=300), rng.choice([11, 21], 300), strict=True
        )
    )
    path, first = next(one for one in drawn if changes_much(one[0], one[1], one[1] + 1))
    assert lost_events(seen(path)) == Lost()
    start, end = 40_000 * first - 5_000, 40_000 * (first + 2) + 31_000
    _cut(path, start, end)
    capture = seen(path)
    assert find_lost(frame_pairs(capture), capture.events) == Lost()
    found = lost_events(capture)
    assert found.spans_us and not found.elsewhere
    # Of a person who turns back one half of it may change little.
    assert found.spans_us[0][0] >= 40_000 * first + 15_000
    assert found.spans_us[-1][1] <= 40_000 * (first + 2) + 15_000
    ((untold_start, untold_end),) = untold_spans(found, capture.events)
    assert untold_start <= start and untold_end >= end
    # A training that was warned does not look for it once more.
    (finding,) = event_findings(capture)
    assert "Most likely the sensor lost them" in str(finding)
    monkeypatch.setattr(sensor_estimate, "find_lost", None)
    build, config = TRAINABLE["evsplat"].build, small_config("evsplat")
    assert build(config, capture, 0, device="cpu", purpose="train").model.sensor is not None


@pytest.mark.parametrize("levels", [0, 3])
def test_nothing_is_lost_while_nobody_moves(
    rng: np.random.Generator, tiny_capture: Factory, few_pairs, levels: int
) -> None:
    """Pictures of one moment with no event between them, with noise of some levels of 255."""
    path = tiny_capture(frames=30, width=64, height=48, seed=int(rng.integers(10_000)))
    for low, high in ((1, 5), (10, 16), (21, 24)):
        still = read_image(path / f"images/{low:04d}.png").astype(np.float64)
        for index in range(low, high + 1):
            noisy = still + levels * rng.standard_normal(still.shape)
            pixels = noisy.round().clip(0, 255).astype(np.uint8)
            Image.fromarray(pixels).save(path / f"images/{index:04d}.png")
        _cut(path, 40_000 * low, 40_000 * high + 30_000)
    capture = seen(path)
    exposures = [frame.exposure_us for frame in capture.train_frames]
    stretch = [capture.events.readable_around(start) for start, _ in exposures]
    assert len(pauses(exposures, stretch, capture.events)) >= 4  # they are looked at
    assert lost_events(capture) == Lost()


def test_pairs_are_forgotten_afterwards_also_after_a_failure(capture) -> None:
    with pytest.raises(KeyError, match="in between"), shared_pairs(capture):
        first = frame_pairs(capture)
        assert frame_pairs(capture) is first
        raise KeyError("in between")
    assert capture.shared_pairs is None  # nor does anything else hold them
    again = frame_pairs(capture)
    assert again is not first
    assert all(map(_same, again, first))
    assert frame_pairs(capture) is not again


def test_pairs_of_large_pictures_are_not_kept(capture, monkeypatch) -> None:
    size = sum(one.change.nbytes + one.usable.nbytes for one in frame_pairs(capture))
    for bound, kept in ((size, True), (size - 1, False)):
        monkeypatch.setattr(sensor_estimate, "_KEPT_BYTES", bound)
        with shared_pairs(capture):
            assert (frame_pairs(capture) is frame_pairs(capture)) == kept
