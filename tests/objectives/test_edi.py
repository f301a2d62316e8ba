"""Sharp targets: the closed form at mid-exposure, kept, compared where it can be trusted."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.events import EventStream, deblur
from evsplat.objectives import EdiTarget, EventNoise, EventSensor
from evsplat.similarity import ssim

HEIGHT, WIDTH = 20, 24


def recording(seed: int):
    """A frame, its blurry picture and random events of its exposure."""
    rng = np.random.default_rng(seed)
    count = 400
    events = EventStream(
        np.sort(rng.integers(1_000, 31_000, count)),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        rng.choice([-1, 1], count).astype(np.int8),
    )
    blurry = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))
    # Neither black nor white, before and after the events.
    blurry = 0.2 + 0.3 * blurry
    frame = SimpleNamespace(name="a", exposure_us=(1_000, 31_000), mid_us=16_000)
    opened = []

    def image(_):
        opened.append(1)
        return blurry

    store = SimpleNamespace(
        between=events.between, height=HEIGHT, width=WIDTH, time_range_us=(1_000, 31_000)
    )
    return SimpleNamespace(events=store, image=image), frame, blurry, opened


def make(capture, **schedule) -> EdiTarget:
    schedule = {"alone_until": 500.0, "weight": 0.5, "end": 2_500.0} | schedule
    noise = EventNoise(capture.events, aware=False)
    return EdiTarget(capture, EventSensor(0.1, 0.15), noise, **schedule)


def step_at(nominal: float, frame, rgb, times):
    return SimpleNamespace(
        frame=frame,
        rgb=rgb,
        nominal=nominal,
        index=times.index,
        data=SimpleNamespace(get=lambda _, make: make()),
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_target_is_the_event_double_integral_and_made_once(seed):
    capture, frame, blurry, opened = recording(seed)
    objective = make(capture)
    events = capture.events.between(*frame.exposure_us)
    expected = deblur(blurry, events, frame.exposure_us, [16_000], (0.1, 0.15))[0]
    for _ in range(3):
        assert (objective.target(frame)[..., :3] - expected).abs().max() <= 0.5 / 255 + 1e-6
    assert len(opened) == 1
    assert (objective.target(frame)[..., 3] == 1).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_loss_looks_at_the_render_in_the_middle_and_fades(seed):
    capture, frame, _, _ = recording(seed)
    objective = make(capture)
    rgb = torch.rand(3, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))
    times = (2_000, 16_000, 30_000)
    target = objective.target(frame)[..., :3]
    distance = 0.8 * (rgb[1] - target).abs().mean() + 0.2 * (1 - ssim(rgb[1], target))
    for nominal, weight in ((0, 1.0), (499, 1.0), (500, 0.5), (1_500, 0.25)):
        assert objective.times(frame, nominal) == (16_000,)
        loss = objective.loss(step_at(nominal, frame, rgb, times))["edi"]
        assert float(loss) == pytest.approx(weight * float(distance), rel=1e-5)
    assert objective.times(frame, 2_500) == ()
    assert objective.loss(step_at(2_500, frame, rgb, times)) == {}


@pytest.mark.parametrize("seed", range(3))
def test_pixels_that_the_camera_cut_off_or_that_fire_by_themselves_teach_nothing(seed):
    capture, frame, blurry, _ = recording(seed)
    blurry[3, 4], blurry[5, 6], blurry[7, 8] = 1.0, 0.0, torch.tensor([0.0, 0.5, 0.0])
    objective = make(capture)
    sound = torch.ones(HEIGHT, WIDTH)
    sound[11, 12] = 0
    objective.noise = SimpleNamespace(sound=sound, weight=lambda duration: 0.6)
    trust = objective.target(frame)[..., 3]
    none = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for pixel in ((3, 4), (5, 6), (11, 12)):
        none[pixel] = True
    assert (trust[none] == 0).all()
    assert torch.allclose(trust[~none], torch.tensor(0.6), atol=1 / 255)


def test_what_is_not_trusted_has_no_gradient():
    capture, frame, _, _ = recording(0)
    objective = make(capture)
    sound = torch.ones(HEIGHT, WIDTH)
    sound[:, :12] = 0
    objective.noise = SimpleNamespace(sound=sound, weight=lambda duration: 1.0)
    rgb = torch.rand(1, HEIGHT, WIDTH, 3, requires_grad=True)
    loss = objective.loss(step_at(0, frame, rgb, (16_000,)))["edi"]
    slope = torch.autograd.grad(loss, rgb)[0][0]
    # Windows of structural similarity reach five pixels, those of their neighbours ten.
    assert slope[:, :2].abs().max() < 1e-9
    assert (slope[:, 12:].abs().amax(-1) > 0).all()
