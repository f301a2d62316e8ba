"""The person before training: what the decoders say after the fit to the body."""

import pytest
import torch

from evsplat.body import skin
from evsplat.body.rotations import matrix_to_six, six_to_matrix
from evsplat.capture import load_body_track, load_capture
from evsplat.models.hugs.gaussians import TriplaneHuman
from evsplat.models.hugs.start import START_OPACITY, body_weights, fit_to_body


@pytest.mark.parametrize("seed", range(3))
def test_six_numbers_make_a_rotation_and_hold_any(seed):
    torch.manual_seed(seed)
    matrices = six_to_matrix(torch.randn(20, 6, dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
    torch.testing.assert_close(matrices @ matrices.mT, eye)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(20, dtype=torch.float64))
    torch.testing.assert_close(six_to_matrix(matrix_to_six(matrices)), matrices)


@pytest.mark.parametrize("seed", range(3))
def test_body_weights_leave_out_vertices_of_another_limb(seed):
    torch.manual_seed(seed)
    vertices, points = torch.rand(80, 3), torch.rand(15, 3)
    # Two limbs, and weights that differ a little within each.
    limb = torch.nn.functional.one_hot(torch.randint(2, (80,)), 2).float()
    weights = (limb + 5e-4 * torch.rand(80, 2)).clamp(0, 1)
    weights /= weights.sum(1, keepdim=True)
    found = body_weights(points, vertices, weights)
    for point, value in zip(points, found, strict=True):
        distance = (vertices - point).norm(dim=1)
        near = distance.argsort()[:6]
        first = weights[near[0]]
        total, shares = torch.zeros(2), 0.0
        for vertex in near:
            if torch.exp(-(weights[vertex] - first).abs().sum() / 0.02) > 0.9:
                share = float(torch.exp(-(distance[vertex] ** 2)))
                total, shares = total + share * weights[vertex], shares + share
        torch.testing.assert_close(value, total / shares)


def test_the_fit_makes_decoders_say_what_the_body_is(tiny_capture):
    body = load_body_track(load_capture(tiny_capture())).body
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    surface = body.sample_surface(2_000, generator)
    low, high = surface.points.amin(0), surface.points.amax(0)
    human = TriplaneHuman(
        surface.points[:100], len(body.parents), channels=8, resolution=16,
        center=(low + high) / 2, half_side=float((high - low).max()),
    )  # fmt: skip
    spacing = 0.03
    fit_to_body(human, surface, spacing, steps=150, batch=256, generator=generator)
    unseen = body.sample_surface(300, torch.Generator().manual_seed(1))
    with torch.no_grad():
        found = human.look_up(unseen.points)
    assert found.offsets.norm(dim=1).mean() < 0.2 * spacing
    assert (found.opacities - START_OPACITY).abs().mean() < 0.05
    shape = human.shape()
    assert float(shape.scales.median()) == pytest.approx(spacing / 2, rel=0.15)
    # What the weights are for: the arm goes where the body's arm goes.
    rotations = torch.eye(3).repeat(1, len(body.parents), 1, 1)
    rotations[0, -1] = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    bones = body.canonical_to_world(rotations, torch.zeros(1, 3))
    moved = skin(unseen.points, found.weights, bones)[0]
    expected = skin(unseen.points, unseen.weights, bones)[0]
    travelled = (expected - unseen.points).norm(dim=-1)
    assert (moved - expected).norm(dim=-1).mean() < 0.1 * travelled.max()
