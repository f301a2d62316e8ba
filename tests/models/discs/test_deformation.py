"""What a person's shape changes by in time: smooth, without a mean, gone in another motion."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from evsplat.body import default_body
from evsplat.models.discs.deformation import Deformation

STEP_US = 80_000
FRAMES_US = [STEP_US * k for k in range(20) if k % 5 < 3]


@pytest.fixture(scope="module")
def surface():
    return default_body().sample_surface(3_000, torch.Generator().manual_seed(0))


@pytest.fixture
def deformation(surface):
    made = Deformation(FRAMES_US, surface)
    with torch.no_grad():
        made.handles.normal_(generator=torch.Generator().manual_seed(1))
    return made


def test_it_starts_at_nothing_and_is_forgotten(surface, deformation):
    everywhere = torch.arange(len(surface.points))
    assert deformation(everywhere, FRAMES_US).abs().max() > 1e-3
    deformation.forget()
    assert not deformation(everywhere, FRAMES_US).any()
    assert not deformation.price().detach()


def test_with_more_freedom_handles_are_more_and_nearer_and_units_larger(surface):
    usual, free = (Deformation(FRAMES_US, surface, freedom=freedom) for freedom in (1.0, 4.0))
    assert free.handles.shape[1] == 4 * usual.handles.shape[1]
    apart = torch.cdist(surface.points, surface.points)
    near = [
        float((apart[one.weights.argmax(1)] * one.weights).sum() / one.weights.sum())
        for one in (usual, free)
    ]
    assert near[1] == pytest.approx(near[0] / 2, rel=0.15)
    with torch.no_grad():
        for one in (usual, free):
            one.handles[:] = torch.linspace(-1, 1, one.spline.count)[:, None, None]
    offsets = [one(torch.arange(9), FRAMES_US) for one in (usual, free)]
    assert torch.allclose(offsets[1], 4 * offsets[0], atol=1e-6)
    assert torch.allclose(free.price(), usual.price())


def test_its_mean_over_the_training_frames_is_zero(surface, deformation):
    """What lasts is the canonical shape's; held-out times count for nothing."""
    offsets = deformation(torch.arange(len(surface.points)), FRAMES_US)
    assert offsets.mean(0).abs().max() < 1e-5 * offsets.abs().max()


def test_each_handle_follows_a_cubic_spline_in_time(deformation):
    knot_us, count = deformation.spline.knot_us, deformation.spline.count
    times = np.linspace(0, FRAMES_US[-1], 31).astype(int)
    basis = BSpline(np.arange(-3.0, count + 1), np.eye(count), 3)
    weights = basis(np.minimum(times / knot_us, count - 3 - 1e-9))
    mean = basis(np.minimum(np.array(FRAMES_US) / knot_us, count - 3 - 1e-9)).mean(0)
    points = deformation.handles.detach().double().numpy()
    wanted = 0.01 * np.einsum("tk,khc->thc", weights - mean, points)
    rows = torch.tensor([0, 7, 1_234])
    wanted = np.einsum("nh,thc->tnc", deformation.weights.T[rows].double().numpy(), wanted)
    found = deformation(rows, times.tolist()).detach().numpy()
    assert np.allclose(found, wanted, rtol=0, atol=1e-6)


def test_handles_that_move_as_one_move_the_body_as_one(surface, deformation):
    """Weights add up to one, and neighbours on the surface move alike."""
    with torch.no_grad():
        deformation.handles[:] = deformation.handles[:, :1]
    moved = deformation(torch.arange(len(surface.points)), [STEP_US])[0]
    assert torch.allclose(moved, moved[:1].expand_as(moved), atol=1e-7)


def test_points_near_each_other_move_alike(surface, deformation):
    moved = deformation(torch.arange(len(surface.points)), [STEP_US])[0].detach()
    apart = torch.cdist(surface.points, surface.points)
    first, second = torch.nonzero((apart < 0.01) & (apart > 0)).unbind(1)
    change = (moved[first] - moved[second]).norm(dim=1)
    # A weight of 7 cm changes by at most exp(-1/2) / 7 cm of itself.
    assert change.max() < 0.3 * moved.norm(dim=1).max()


def test_gradients_are_those_of_finite_differences(deformation):
    rows, generator = torch.tensor([3, 500, 2_900]), torch.Generator().manual_seed(2)
    look = torch.randn(2, 3, 3, generator=generator)

    def value():
        return (deformation(rows, [STEP_US, 7 * STEP_US + 9]) * look).sum()

    points = deformation.handles
    gradient = torch.autograd.grad(value(), points)[0]
    direction = torch.randn(points.shape, generator=generator)
    start = points.detach().clone()
    ends = []
    for step in (1.0, -1.0):
        with torch.no_grad():
            points.copy_(start + step * direction)
        ends.append(float(value()))
    # Linear in the control points.
    assert float((gradient * direction).sum()) == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-3)
