"""The event loss of eq. 8-9 and what makes it well behaved."""

import math

import h5py
import pytest
import torch

from evsplat.objectives.event import EventChange, event_loss
from evsplat.pictures import decode, encode, log_brightness_change

from ..seen import seen


def blob(size: int, shift: float) -> torch.Tensor:
    """A bright textured figure before a dark wall, moved by ``shift`` of a 256-pixel picture."""
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    x = x - shift / 256
    figure = torch.exp(-(((x - 0.5) / 0.08) ** 4) - ((y - 0.5) / 0.25) ** 4)
    texture = 0.5 + 0.3 * torch.sin(60 * x) * torch.cos(40 * y)
    return (0.15 + 0.6 * figure * texture)[..., None].repeat(1, 1, 3)


@pytest.mark.parametrize("seed", range(3))
def test_scaling_either_map_changes_the_loss_only_through_the_floor(seed):
    generator = torch.Generator().manual_seed(seed)
    change = torch.randn(20, 30, generator=generator)
    events = torch.randn(20, 30, generator=generator)
    plain = event_loss(change, events, floor=0.0)
    assert torch.allclose(event_loss(change, 7 * events, floor=0.0), plain, rtol=1e-5)
    assert torch.allclose(event_loss(0.2 * change, events, floor=0.0), plain, rtol=1e-5)


def test_loss_is_the_closed_form_of_equation_9():
    change = torch.tensor([[3.0, 0.0], [0.0, 4.0]])
    events = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    expected = (abs(0.6 - 1.0) + 0.8) / math.sqrt(4)
    assert float(event_loss(change, events, floor=0.0)) == pytest.approx(expected)


def test_value_does_not_depend_on_resolution():
    values = []
    for size in (64, 128, 256):
        change = log_brightness_change(blob(size, 0), blob(size, 6))
        wrong = log_brightness_change(blob(size, 0), blob(size, 3))
        values.append(float(event_loss(wrong, change / 0.2)))
    assert max(values) / min(values) < 1.15


def test_right_motion_costs_least_and_noise_costs_less_than_unit_norm_would():
    events = log_brightness_change(blob(128, 0), blob(128, 6)) / 0.2
    right = event_loss(log_brightness_change(blob(128, 0), blob(128, 6)), events)
    half = event_loss(log_brightness_change(blob(128, 0), blob(128, 3)), events)
    back = event_loss(log_brightness_change(blob(128, 6), blob(128, 0)), events)
    assert float(right) < 0.5 * float(half) < 0.5 * float(back)
    noise = 1e-3 * torch.randn(128, 128, generator=torch.Generator().manual_seed(0))
    assert float(event_loss(noise, events)) < 0.7 * float(event_loss(noise, events, floor=0.0))


def test_no_change_and_no_events_cost_nothing_and_give_finite_gradients():
    change = torch.zeros(8, 8, requires_grad=True)
    loss = event_loss(change, torch.zeros(8, 8))
    loss.backward()
    assert float(loss) == 0
    assert change.grad is not None and bool(change.grad.isfinite().all())


def test_brightness_change_of_a_known_factor_is_its_logarithm():
    dark = torch.full((4, 4, 3), 0.2)
    bright = encode(2 * decode(dark))
    change = log_brightness_change(dark, bright, eps=0.0)
    assert torch.allclose(change, torch.full((4, 4), math.log(2)), atol=1e-5)
    assert torch.allclose(log_brightness_change(bright, dark, eps=0.0), -change, atol=1e-6)


def test_gradient_of_the_loss_agrees_with_finite_differences():
    generator = torch.Generator().manual_seed(5)
    before = 0.2 + 0.6 * torch.rand(3, 4, 3, generator=generator, dtype=torch.float64)
    after = 0.2 + 0.6 * torch.rand(3, 4, 3, generator=generator, dtype=torch.float64)
    events = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    after.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda image: event_loss(log_brightness_change(before, image), events), (after,)
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("floor", [0.0, 0.03])
def test_compiled_loss_and_its_gradient_equal_plain_torch_in_float64(seed, floor):
    generator = torch.Generator().manual_seed(seed)
    shape = ((20, 30), (37, 29), (1, 3), (150, 220))[seed]
    change = torch.randn(shape, generator=generator)
    events = torch.randint(-3, 4, shape, generator=generator).float()
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = change.detach().to(dtype).requires_grad_()
        loss = event_loss(leaf, events.to(dtype), floor=floor)
        (3 * loss).backward()
        results.append((loss.detach().double(), leaf.grad.double()))
    (loss, gradient), (expected, expected_gradient) = results
    assert float(loss) == pytest.approx(float(expected), rel=2e-6)
    assert (gradient - expected_gradient).norm() < 5e-6 * expected_gradient.norm()


def test_compiled_loss_of_no_number_is_none():
    change = torch.ones(20, 30)
    change[3, 4] = math.nan
    assert bool(event_loss(change, torch.ones(20, 30)).isnan())


def test_pairs_never_cross_held_out_frames(tiny_capture):
    capture = seen(tiny_capture(frames=20), held_out_events=True)
    objective = EventChange(capture, start=0, min_active=0.0)
    mids = [frame.mid_us for frame in capture.frames]
    pairs = {objective.times(frame, 1.0) for frame in capture.train_frames}
    steps = {(mids.index(a), mids.index(b)) for a, b in pairs}
    assert steps == {(i, i + 1) for i in (*range(6), *range(10, 16))}
    assert len(pairs) == len(objective.weights)


@pytest.mark.parametrize("seed", range(3))
def test_the_papers_term_takes_events_without_polarity(tiny_capture, seed):
    """Where all pixels only brighten, sizes and signed changes say the same."""
    path = tiny_capture(seed=seed)
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/p"][:] = 1
    signed = EventChange(seen(path), start=0)
    pair = next(iter(signed.weights))
    changed = signed._map(*pair)
    signed.events.close()
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/p"][:] = 0
    blind = EventChange(seen(path), start=0)
    assert changed.any() and (changed == blind._map(*pair)).all()
    assert signed.weights == blind.weights
