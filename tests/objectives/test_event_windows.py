"""Event windows: right thresholds explain what a changing picture did, wrong ones do not."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.devices import DeviceCache
from evsplat.events import ALWAYS, EventStream, window_counts
from evsplat.objectives import EventNoise, EventSensor, EventWindows
from evsplat.pictures import CodedPictures, luminance

HEIGHT, WIDTH, EPS = 9, 11, 0.004


class Recording:
    """Events of pixels whose log-brightness moves by whole thresholds at known times."""

    height, width = HEIGHT, WIDTH

    def __init__(self, stream: EventStream, has_polarity: bool = True) -> None:
        self.stream, self.has_polarity = stream, has_polarity
        self.time_range_us = (int(stream.t[0]), int(stream.t[-1]) + 1)
        self.stretches_us = (self.time_range_us,)
        self.readable_us = (ALWAYS,)

    def __len__(self) -> int:
        return len(self.stream)

    def between(self, start: int, end: int) -> EventStream:
        assert any(low <= start and end <= high for low, high in self.readable_us)
        return self.stream.between(start, end)

    def readable_around(self, time: int) -> tuple[int, int]:
        return next(span for span in self.readable_us if span[0] <= time <= span[1])


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
    stream = in_order(t, x, y, p)
    frames = [SimpleNamespace(mid_us=mid) for mid in (0, 10_000, 20_000)]
    capture = SimpleNamespace(events=Recording(stream), frames=frames, train_frames=frames)
    return capture, step_at(times, linear)


def in_order(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> EventStream:
    """A stream of events that came in any order."""
    order = np.argsort(t, kind="stable")
    return EventStream(
        t[order].astype(np.int64),
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        p[order].astype(np.int8),
    )


class StepAt(SimpleNamespace):
    """A step whose pictures are known in linear light."""

    data = DeviceCache("cpu", 0)

    @property
    def pictures(self) -> "StepAt":
        return self

    def log_luminance(self, eps: float, which: slice, *, keeps_hue: bool) -> torch.Tensor:
        if keeps_hue:
            pictures = CodedPictures(self.linear[which].unbind(0), "linear")
            return pictures.log_luminance(eps, keeps_hue=True)
        return torch.log(luminance(self.linear[which]) + eps)


def step_at(times: tuple[int, ...], linear: torch.Tensor) -> StepAt:
    """A step of a frame in the middle of ``times``."""
    frame = SimpleNamespace(mid_us=(times[0] + times[-1]) // 2)
    return StepAt(times_us=times, linear=linear, nominal=5_000.0, frame=frame)


def make(
    capture, on: float, off: float, ramp_us: int = 0, flicker_us: int = 0, **learned
) -> EventWindows:
    sensor = EventSensor(on, off, **learned).double()
    generator = torch.Generator().manual_seed(0)
    options = {"start": 750, "eps": EPS, "reach": 0.5, "flicker_us": flicker_us}
    noise = EventNoise(capture.events, aware=False)
    return EventWindows(capture, sensor, generator, noise=noise, ramp_us=ramp_us, **options)


@pytest.mark.parametrize("seed", range(3))
def test_right_thresholds_explain_every_window_and_wrong_ones_by_how_much(seed):
    capture, step = scene(seed)
    assert float(make(capture, 0.3, 0.2).loss(step)["event"]) < 1e-6
    wrong = make(capture, 0.4, 0.2)
    loss = wrong.loss(step)["event"]
    stream = capture.events.stream
    counts = window_counts(stream, step.times_us, HEIGHT, WIDTH).double()[:, 0]
    expected = 0.5 * 0.1 * (float(counts.mean()) + float(counts.sum(0).mean()))
    assert float(loss) == pytest.approx(expected, rel=1e-6)
    loss.backward()
    assert wrong.sensor.logs.grad[0] > 0  # a smaller threshold fits better


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_asked_of_times_at_which_events_were_lost(seed):
    capture, step = scene(seed)
    stream, lost_us = capture.events.stream, (2_600, 6_900)
    kept = (stream.t < lost_us[0]) | (stream.t >= lost_us[1])
    capture.events = Recording(stream.take(kept))
    as_it_is, told = make(capture, 0.3, 0.2), make(capture, 0.3, 0.2)
    told.untold_us = (lost_us,)
    # Frames of 2 ms within the loss, before it and after it.
    for middle, asked in ((4_000, ()), (1_500, (0, 2_600)), (8_500, (6_900, 14_500))):
        step.frame = SimpleNamespace(mid_us=middle, exposure_us=(middle - 1_000, middle + 1_000))
        times = [time for _ in range(40) for time in told.times(step.frame, 5_000)]
        assert bool(times) == bool(asked)
        assert all(asked[0] <= time <= asked[1] for time in times)
        wrong = told.loss(step)
        assert ("event" in wrong) == bool(asked) and float(
            wrong.get("event", torch.zeros(())).detach()
        ) < 1e-6
        assert float(as_it_is.loss(step)["event"].detach()) > 0.01


@pytest.mark.parametrize(("hue_from", "alike"), [(5_000, True), (5_001, False)])
def test_from_its_start_on_events_pull_at_all_channels_alike(hue_from, alike):
    capture, step = scene(0)
    colours = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    logs = (step.linear + EPS).mul(colours).log().requires_grad_()
    step.linear = logs.exp() - EPS
    objective = make(capture, 0.3, 0.2)
    objective.hue_from = hue_from
    loss = objective.loss(step)["event"]
    loss.backward()
    pulls = logs.grad[logs.grad.abs().sum(-1) > 0]
    assert len(pulls) > 100
    apart = pulls.amax(-1) - pulls.amin(-1)
    assert (float(apart.max()) < 1e-12) == alike
    # The value is what luminance has.
    objective.hue_from = 15_000
    assert torch.equal(loss, objective.loss(step)["event"])


@pytest.mark.parametrize("late_us", [None, 120.0])
def test_the_loss_and_its_slopes_are_those_of_the_differences(late_us):
    """What is written out at once against autograd through what held-out frames ask for."""
    capture, step = scene(1)
    objective = make(capture, 0.25, 0.35, late_us=late_us)
    light = step.linear.clone().requires_grad_()
    step.linear = light
    parameters = [light, *objective.sensor.parameters()]
    wrong = objective.differences(step, slice(None))
    times = step.times_us
    lasting = [end - start for start, end in zip(times, times[1:], strict=False)]
    whole = objective.mean(wrong.sum(0, keepdim=True), [times[-1] - times[0]])
    plain = 0.5 * (objective.mean(wrong, lasting) + whole)
    found = objective.loss(step)["event"]
    assert float(found) == pytest.approx(float(plain), rel=1e-6)
    ours, theirs = (
        torch.autograd.grad(loss, parameters, allow_unused=True) for loss in (found, plain)
    )
    for one, other in zip(ours, theirs, strict=True):
        if other is None:  # no clock is learned
            assert late_us is None and one is None
        else:
            assert torch.allclose(one, other, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_learned_thresholds_come_back(seed):
    capture, step = scene(seed)
    objective = make(capture, 0.2, 0.2)
    adam = torch.optim.Adam(objective.sensor.parameters(), lr=0.02)
    for _ in range(150):
        adam.zero_grad()
        objective.loss(step)["event"].backward()
        adam.step()
    assert torch.allclose(objective.sensor.logs.exp(), torch.tensor([0.3, 0.2]).double(), rtol=0.05)


@pytest.mark.parametrize("ramp_us", [0, 4_000])
@pytest.mark.parametrize("late_us", [None, 120.0])
def test_events_counted_on_a_device_give_the_same_differences(ramp_us, late_us):
    capture, step = scene(0)
    objective = make(capture, 0.25, 0.25, ramp_us, late_us=late_us)
    found = []
    for data in (step.data, Elsewhere()):
        step.data = data
        objective.sensor.zero_grad()
        loss = objective.loss(step)["event"]
        loss.backward()
        learned = [p.grad for p in objective.sensor.parameters() if p.grad is not None]
        found.append([loss.detach(), *(grad.clone() for grad in learned)])
        objective.prefetch(SimpleNamespace(mid_us=5_000, exposure_us=(4_000, 6_000)), 5_000, data)
    for ours, expected in zip(*found, strict=True):
        assert torch.allclose(ours, expected, rtol=1e-4, atol=1e-6)


class Elsewhere:
    """A cache that calls the CPU another device."""

    device = torch.device("meta")

    def get(self, key, make):
        return make()

    def prefetch(self, key, make):
        assert make().dtype == torch.int64


def test_thresholds_are_held_where_they_started():
    thresholds = EventSensor(0.2, 0.3)
    assert float(thresholds.apart()) == 0.0
    with torch.no_grad():
        thresholds.logs += torch.tensor([0.1, -0.3])
    assert float(thresholds.apart()) == pytest.approx((0.01 + 0.09) / 2)
    resumed = EventSensor(1.0, 1.0)
    resumed.load_state_dict(thresholds.state_dict())
    assert float(resumed.apart()) == pytest.approx(0.05)
    assert resumed.offset_us is None


def test_a_saved_sensor_says_whether_its_clock_is_learned():
    sensor, resumed = EventSensor(0.2, 0.3, late_us=5_000.0), EventSensor(1.0, 1.0)
    resumed.load_state_dict(sensor.state_dict())
    assert float(resumed.offset_us) == pytest.approx(5_000.0)


def test_a_time_outside_of_the_exposure_is_asked_for_after_the_start():
    capture, _ = scene(0)
    objective = make(capture, 0.2, 0.2)
    frame = SimpleNamespace(exposure_us=(9_000, 11_000), mid_us=10_000)
    assert objective.times(frame, 700) == ()
    drawn = [objective.times(frame, 800)[0] for _ in range(100)]
    assert all(3_999 <= time < 9_000 or 11_000 <= time <= 16_000 for time in drawn)
    assert any(time < 9_000 for time in drawn) and any(time > 9_000 for time in drawn)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("begins", [True, False])
def test_a_recording_says_nothing_of_frames_before_or_after_it(seed, begins):
    """Two cameras are not switched on and off together."""
    capture, step = scene(seed)
    # the events of 1 to 9 ms are the last, or the first, of a recording of many more frames
    beside = range(-90_000, 1, 10_000) if begins else range(10_000, 101_000, 10_000)
    capture.frames = capture.train_frames = [
        SimpleNamespace(mid_us=mid, exposure_us=(mid - 4_000, mid + 4_000))
        for mid in sorted([*beside, 10_000 if begins else 0])
    ]
    objective = make(capture, 0.3, 0.2)
    far = capture.frames[0 if begins else -1]
    assert objective.times(far, 5_000) == ()
    times = tuple(far.mid_us + time for time in (-4_000, -1_000, 4_000))
    pictures = torch.rand(3, HEIGHT, WIDTH, 1).double().expand(-1, -1, -1, 3)
    moved = StepAt(times_us=times, linear=pictures, nominal=5_000.0, frame=far)
    assert objective.loss(moved) == {}
    # within the recording nothing is different: of its times those up to the last event are kept
    inner = slice(1, 3)
    known = StepAt(
        times_us=step.times_us[inner], linear=step.linear[inner], nominal=5_000.0, frame=step.frame
    )
    assert float(objective.loss(known)["event"]) < 1e-6
    for _ in range(30):
        drawn = objective.times(capture.frames[-1 if begins else 0], 5_000)
        assert all(-4_000 <= time <= 14_000 for time in drawn)


@pytest.mark.parametrize("seed", range(3))
def test_without_polarity_the_size_of_the_change_is_compared(seed):
    capture, step = scene(seed, on=0.25, off=0.25)
    stream = capture.events.stream
    blind = EventStream(stream.t, stream.x, stream.y, np.zeros_like(stream.p))
    capture.events = Recording(blind, has_polarity=False)
    assert float(make(capture, 0.25, 0.25).loss(step)["event"]) < 1e-6
    counts = np.zeros(HEIGHT * WIDTH)
    np.add.at(counts, stream.y.astype(int) * WIDTH + stream.x, 1)
    off_by = make(capture, 0.35, 0.35).loss(step)["event"]
    assert float(off_by) == pytest.approx(0.1 * counts.mean() / 3, rel=1e-5)  # three windows


def moving_edge(late_us: int):
    """A bright edge that runs over the picture, and its events, stamped ``late_us`` too late."""
    times = (20_000, 28_000, 36_000, 44_000)
    column = torch.arange(WIDTH).double()

    def log(time):
        return -3 + 2 * torch.sigmoid((time / 5_000 - 1 - column) / 0.8)

    parts = []
    grid = np.arange(0, 80_000, 50)
    for x in range(WIDTH):
        crossed = np.floor(torch.stack([log(t) for t in grid.tolist()])[:, x] / 0.02)
        at = grid[1:][np.diff(crossed.numpy()) > 0]
        parts += [(at, np.full(len(at), x), np.full(len(at), y)) for y in range(HEIGHT)]
    t, x, y = (np.concatenate(values) for values in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    stream = EventStream(
        (t[order] + late_us).astype(np.int64),
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        np.ones(len(t), dtype=np.int8),
    )
    frames = [SimpleNamespace(mid_us=mid) for mid in (0, 40_000, 80_000)]
    linear = torch.stack([log(t).exp() - EPS for t in times])
    step = step_at(times, linear[:, None, :, None].expand(-1, HEIGHT, -1, 3))
    return SimpleNamespace(events=Recording(stream), frames=frames, train_frames=frames), step


@pytest.mark.parametrize("late_us", [-3_000, 0, 4_000])
def test_a_clock_that_is_late_is_found(late_us):
    capture, step = moving_edge(late_us)
    objective = make(capture, 0.02, 0.02, late_us=0.0)
    objective.sensor.logs.requires_grad_(False)
    adam = torch.optim.Adam([objective.sensor.offset], lr=0.02)
    for iteration in range(150):
        adam.param_groups[0]["lr"] = 0.02 * 0.97**iteration
        adam.zero_grad()
        objective.loss(step)["event"].backward()
        adam.step()
    assert float(objective.sensor.offset_us) == pytest.approx(late_us, abs=300)


@pytest.mark.parametrize("seed", range(3))
def test_steady_change_is_explained_between_its_events_too(seed):
    rng = np.random.default_rng(seed)
    on, off, times = 0.37, 0.3, (31_000, 44_500, 63_000)
    y, x = np.divmod(np.arange(HEIGHT * WIDTH), WIDTH)
    sign = rng.choice([-1, 1], len(x))
    period_us = rng.integers(5_000, 20_000, len(x))
    steps = [np.arange(period, 100_000, period) for period in period_us]
    t = np.concatenate(steps)
    order = np.argsort(t, kind="stable")
    pixel = np.repeat(np.arange(len(x)), [len(each) for each in steps])[order]
    stream = EventStream(
        t[order],
        x[pixel].astype(np.uint16),
        y[pixel].astype(np.uint16),
        sign[pixel].astype(np.int8),
    )
    frames = [SimpleNamespace(mid_us=mid) for mid in (0, 50_000, 100_000)]
    capture = SimpleNamespace(events=Recording(stream), frames=frames, train_frames=frames)
    slope = torch.from_numpy(np.where(sign > 0, on, -off) / period_us)
    log = slope.view(HEIGHT, WIDTH) * torch.tensor(times).view(-1, 1, 1)
    linear = (log.exp() - EPS)[..., None].expand(-1, -1, -1, 3)
    step = step_at(times, linear)
    assert float(make(capture, on, off, ramp_us=20_000).loss(step)["event"]) < 1e-6
    assert float(make(capture, on, off).loss(step)["event"]) > 0.05


@pytest.mark.parametrize("rate_hz", [0.3, 8.0])
@pytest.mark.parametrize("seed", range(2))
def test_noise_lowers_the_weight_and_hot_pixels_have_none(seed, rate_hz):
    rng = np.random.default_rng(seed)
    height, width, seconds = 60, 80, 4
    pixels = height * width
    count = rng.poisson(rate_hz * seconds * pixels)
    place = np.concatenate([rng.integers(0, pixels, count), np.full(4_000, 17 * width + 23)])
    t = np.concatenate([rng.integers(0, seconds * 1_000_000, count), np.arange(4_000) * 999])
    order = np.argsort(t, kind="stable")
    y, x = np.divmod(place[order], width)
    sign = rng.choice([-1, 1], len(t))
    stream = EventStream(t[order], x.astype(np.uint16), y.astype(np.uint16), sign.astype(np.int8))
    events = Recording(stream)
    events.height, events.width = height, width
    noise = EventNoise(events)
    allowed = rate_hz * np.array([0.8, 1.2]) / 2
    low, high = 1 / (1 + 2 * np.sqrt(allowed[::-1]))
    assert low < noise.weight(500_000) < high
    assert noise.sound[17, 23] == 0 and float(noise.sound.sum()) == pixels - 1
    assert EventNoise(events, aware=False).weight(500_000) == 1.0


@pytest.mark.parametrize("ramp_us", [0, 4_000])
@pytest.mark.parametrize("late_us", [None, 120.0])
def test_the_compiled_comparison_and_its_gradients_are_those_of_the_plain_one(ramp_us, late_us):
    results = []
    for dtype in (torch.float64, torch.float32):
        capture, step = scene(3)
        windows = make(capture, 0.25, 0.22, ramp_us, late_us=late_us)
        windows.sensor.to(dtype)
        windows.noise = SimpleNamespace(
            sound=(torch.arange(HEIGHT * WIDTH).view(HEIGHT, WIDTH) % 7 > 0).float(),
            weight=lambda duration: 1 / (1 + 1e-4 * duration),
        )
        step.linear = step.linear.to(dtype, copy=True).contiguous().requires_grad_()
        terms = windows.loss(step)
        learned = [windows.sensor.logs, *([] if late_us is None else [windows.sensor.offset])]
        gradients = torch.autograd.grad(terms["event"], [step.linear, *learned])
        results.append([terms["event"], *gradients])
    for plain, compiled in zip(*results, strict=True):
        assert plain.abs().max() > 0
        assert (compiled - plain).abs().max() < 1e-5 * plain.abs().max()


def flickering(seed: int, period_us: int):
    """`scene`, and each pixel once brighter and once darker in every period, when it pleases."""
    capture, step = scene(seed)
    rng = np.random.default_rng(seed + 100)
    y, x = (places.ravel() for places in np.mgrid[:HEIGHT, :WIDTH])
    starts = np.arange(-20 * period_us, 30_000, period_us)
    # Whole tenths of a period, at which the mean over ten instants is exact.
    tenths = period_us // 10
    first, later = (tenths * rng.integers(0, 10, len(x)) for _ in range(2))
    columns = [[events] for events in (capture.events.stream.t, *_places(capture.events.stream))]
    for start in starts:
        for shift, sign in ((first, 1), (later, -1)):
            for column, values in zip(columns, (start + shift, x, y, 0 * x + sign), strict=True):
                column.append(values)
    t, x, y, p = (np.concatenate(column) for column in columns)
    stream = in_order(t, x, y, p)
    capture.events.stream = stream
    capture.events.time_range_us = (int(stream.t[0]), int(stream.t[-1]) + 1)
    return capture, step


def _places(stream: EventStream) -> tuple[np.ndarray, ...]:
    return stream.x, stream.y, stream.p


@pytest.mark.parametrize("seed", range(3))
def test_over_whole_periods_lamps_change_nothing(seed):
    """What flickers adds exactly nothing; what else is reported is its mean over the period."""
    period_us, lit = 800, 0.25
    with_it, step = flickering(seed, period_us)
    without, _ = scene(seed)
    without.events.time_range_us = with_it.events.time_range_us
    given, expected = (
        make(capture, lit, lit, flicker_us=period_us).differences(step, slice(None))
        for capture in (with_it, without)
    )
    assert float((given - expected).abs().max()) < 1e-6
    as_they_are = make(with_it, lit, lit).differences(step, slice(None))
    true = make(without, lit, lit).differences(step, slice(None))
    assert float((as_they_are - true).abs().mean()) > 0.05


@pytest.mark.parametrize("reach_us", [0, 40_000])
def test_a_mean_over_a_period_asks_for_no_event_that_is_held_out(reach_us):
    """Instants whose whole period may not be read are not compared."""
    period_us = 800
    capture, step = flickering(0, period_us)
    objective = make(capture, 0.3, 0.2, ramp_us=reach_us, flicker_us=period_us)
    capture.events.readable_us = ((0, 8_000),)
    step.frame = SimpleNamespace(mid_us=5_000)
    step.times_us = (300, 2_500, 7_000, 7_700)
    assert objective.readable(step) == slice(1, 3)
    assert set(objective.loss(step)) == {"event", "contrast"}
    frame = SimpleNamespace(mid_us=5_000, exposure_us=(1_000, 7_000))
    for _ in range(50):
        (time,) = objective.times(frame, 1_000)
        assert 400 <= time <= 7_600
