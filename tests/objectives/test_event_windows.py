"""Event windows: right thresholds explain what a changing picture did, wrong ones do not."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.events import EventStream
from evsplat.objectives import ContrastThresholds, EventWindows

HEIGHT, WIDTH, EPS = 9, 11, 0.004


class Recording:
    """Events of pixels whose log-brightness moves by whole thresholds at known times."""

    height, width = HEIGHT, WIDTH

    def __init__(self, stream: EventStream) -> None:
        self.stream = stream

    def between(self, start: int, end: int) -> EventStream:
        return self.stream.between(start, end)


def scene(seed: int, on: float = 0.3, off: float = 0.2):
    """Four pictures and the events between them."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(-3, 4, size=(3, HEIGHT, WIDTH))
    change = np.where(steps > 0, on * steps, off * steps)
    log = np.concatenate([np.full((1, HEIGHT, WIDTH), -2.0), -2.0 + change.cumsum(0)])
    linear = torch.tensor(np.exp(log) - EPS)[..., None].expand(-1, -1, -1, 3)
    times = (1_000, 2_500, 7_000, 9_000)
    parts = []
    for window, count in enumerate(steps):
        y, x = np.nonzero(count)
        repeats = np.abs(count[y, x])
        t = rng.integers(times[window], times[window + 1], repeats.sum())
        p = np.sign(count[y, x])
        parts.append((t, *(np.repeat(v, repeats) for v in (x, y, p))))
    t, x, y, p = (np.concatenate(values) for values in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    stream = EventStream(
        t[order].astype(np.int64),
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        p[order].astype(np.int8),
    )
    frames = [SimpleNamespace(mid_us=mid) for mid in (0, 10_000, 20_000)]
    capture = SimpleNamespace(events=Recording(stream), frames=frames)
    return capture, SimpleNamespace(times_us=times, linear=linear, nominal=5_000.0)


def make(capture, on: float, off: float) -> EventWindows:
    thresholds = ContrastThresholds(on, off).double()
    generator = torch.Generator().manual_seed(0)
    return EventWindows(capture, thresholds, generator, start=750, eps=EPS, reach=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_right_thresholds_explain_every_window_and_wrong_ones_by_how_much(seed):
    capture, step = scene(seed)
    assert float(make(capture, 0.3, 0.2).loss(step)["event"]) < 1e-6
    wrong = make(capture, 0.4, 0.2)
    loss = wrong.loss(step)["event"]
    counts = wrong._counts(capture.events.stream, step.times_us).double()[:, 0]
    expected = 0.5 * 0.1 * (float(counts.mean()) + float(counts.sum(0).mean()))
    assert float(loss) == pytest.approx(expected, rel=1e-6)
    loss.backward()
    assert wrong.thresholds.logs.grad[0] > 0  # a smaller threshold fits better


@pytest.mark.parametrize("seed", range(3))
def test_learned_thresholds_come_back(seed):
    capture, step = scene(seed)
    objective = make(capture, 0.2, 0.2)
    adam = torch.optim.Adam(objective.thresholds.parameters(), lr=0.02)
    for _ in range(150):
        adam.zero_grad()
        objective.loss(step)["event"].backward()
        adam.step()
    assert torch.allclose(
        objective.thresholds.logs.exp(), torch.tensor([0.3, 0.2]).double(), rtol=0.05
    )


def test_thresholds_are_held_where_they_started():
    thresholds = ContrastThresholds(0.2, 0.3)
    assert float(thresholds.apart()) == 0.0
    with torch.no_grad():
        thresholds.logs += torch.tensor([0.1, -0.3])
    assert float(thresholds.apart()) == pytest.approx((0.01 + 0.09) / 2)
    resumed = ContrastThresholds(1.0, 1.0)
    resumed.load_state_dict(thresholds.state_dict())
    assert float(resumed.apart()) == pytest.approx(0.05)


def test_a_time_outside_of_the_exposure_is_asked_for_after_the_start():
    capture, _ = scene(0)
    objective = make(capture, 0.2, 0.2)
    frame = SimpleNamespace(exposure_us=(9_000, 11_000))
    assert objective.times(frame, 700) == ()
    drawn = [objective.times(frame, 800)[0] for _ in range(100)]
    assert all(3_999 <= time < 9_000 or 11_000 <= time <= 16_000 for time in drawn)
    assert any(time < 9_000 for time in drawn) and any(time > 9_000 for time in drawn)
