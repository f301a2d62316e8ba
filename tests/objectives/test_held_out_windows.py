"""Windows around held-out frames: where they lie, and what they say of pictures and events."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from evsplat.objectives import HeldOutWindows

from .test_event_windows import make as make_windows
from .test_event_windows import scene


def make(capture, on: float = 0.3, off: float = 0.2) -> HeldOutWindows:
    return HeldOutWindows(make_windows(capture, on, off), capture.train_frames)


def frame(mid: int) -> SimpleNamespace:
    return SimpleNamespace(mid_us=mid, exposure_us=(mid - 4_000, mid + 4_000))


@pytest.mark.parametrize("held", [30_000, 40_000])
def test_times_lie_around_the_frame_and_one_in_the_nearest_training_exposure(held):
    capture, _ = scene(0)
    capture.train_frames = [frame(mid) for mid in (0, 20_000, 60_000, 70_000)]
    capture.frames = [*capture.train_frames, frame(30_000), frame(40_000), frame(50_000)]
    objective = make(capture)
    sides = set()
    for _ in range(60):
        times = objective.times(frame(held), 0)
        around = [t for t in times if held - 5_000 <= t <= held + 5_000]
        (anchor,) = set(times) - set(around)
        assert len(around) == 3 and times == sorted(times)
        assert 16_000 <= anchor < 24_000 or 56_000 <= anchor < 64_000
        sides.add(anchor < held)
    assert sides == {True, False}
    capture.train_frames = capture.train_frames[2:]
    assert max(make(capture).times(frame(held), 0)) >= 56_000


@pytest.mark.parametrize(("seed", "mid"), [(0, 8_000), (1, 2_000), (2, 9_000)])
def test_right_thresholds_explain_all_and_wrong_ones_by_how_much(seed, mid):
    capture, step = scene(seed)
    capture.train_frames = [frame(0), frame(20_000)]
    step.frame = frame(mid)
    assert float(make(capture).loss(step)["event"].detach()) < 1e-6
    found = make(capture, 0.4, 0.2).loss(step)["event"]
    stream, edges = capture.events.stream, itertools.pairwise(step.times_us)
    counts = [int((stream.between(*ends).p > 0).sum()) for ends in edges]
    # The farther end of the times is the training exposure's.
    sums = np.cumsum(counts if mid > 5_000 else counts[::-1])
    pixels = 3 * capture.events.height * capture.events.width
    expected = 0.05 * (np.sum(counts) + np.sum(sums)) / pixels
    assert float(found.detach()) == pytest.approx(expected, rel=1e-6)


def test_without_polarity_there_are_no_sums():
    capture, step = scene(3)
    capture.train_frames, step.frame = [frame(0), frame(20_000)], frame(8_000)
    with_sums = float(make(capture, 0.4, 0.2).loss(step)["event"].detach())
    capture.events.has_polarity = False
    objective = make(capture, 0.4, 0.2)
    found = float(objective.loss(step)["event"].detach())
    lasting = np.diff(step.times_us).tolist()
    each = objective.windows.mean(objective.windows.differences(step, slice(None)), lasting)
    assert found == pytest.approx(float(each.detach())) and found != pytest.approx(with_sums)
