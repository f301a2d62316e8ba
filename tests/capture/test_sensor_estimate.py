"""The pairs of frames that clock, thresholds and the check of the events are found from."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from evsplat.calibration import FramePair, exposure, pair
from evsplat.capture import TrainingCapture, estimate_sensor, sensor_estimate, shared_pairs
from evsplat.capture.sensor_estimate import frame_pairs
from evsplat.inspection.event_check import event_findings

from ..seen import seen

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
