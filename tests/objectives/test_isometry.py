"""Isometry: zero for rigid motion, right for a known stretch, never with stale neighbours."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.gaussians import GaussianSet
from evsplat.gaussians.initialise import gaussians_at
from evsplat.objectives import Isometry
from evsplat.objectives.isometry import isometry_change


def make_step(seed: int, count: int = 60, turn: float = 0.7, stretch: float = 1.0):
    """Random Gaussians, all carried by one rotation, a shift and a stretch of the space."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator)
    scales = 0.01 + 0.05 * torch.rand(count, 3, generator=generator)
    values = gaussians_at(points, scales, opacity=0.5, semantic_logit=2.0)
    values["quaternions"] = torch.nn.functional.normalize(
        torch.randn(count, 4, generator=generator), dim=-1
    )
    gaussians = GaussianSet(values, {name: value[:0] for name, value in values.items()})
    c, s = torch.cos(torch.tensor(turn)), torch.sin(torch.tensor(turn))
    matrix = torch.eye(4)
    matrix[:2, :2] = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    matrix[:3, :3] *= stretch
    matrix[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    moved = gaussians.means.detach() @ matrix[:3, :3].T + matrix[:3, 3]
    human = SimpleNamespace(
        means=moved[None],
        quaternions=gaussians.quaternions.detach()[None],
        scales=gaussians.scales_log.detach().exp()[None],
    )
    return SimpleNamespace(
        model=SimpleNamespace(gaussians=gaussians),
        layers=SimpleNamespace(human=human, transforms=matrix.expand(1, count, 4, 4)),
        generator=generator,
    )


@pytest.mark.parametrize("seed", range(3))
def test_rigid_motion_costs_nothing_for_centres(seed):
    terms = Isometry(refresh=100, samples=1_000).loss(make_step(seed))
    assert float(terms["isometry_centers"]) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_a_stretch_costs_what_the_distances_grow(seed):
    step = make_step(seed, stretch=1.25)
    terms = Isometry(refresh=100, samples=60).loss(step)
    points = step.model.gaussians.means.detach()
    distances = torch.cdist(points, points).sort(dim=1).values[:, 1:5]
    assert float(terms["isometry_centers"]) == pytest.approx(
        0.25 * float(distances.mean()), rel=1e-4
    )


def test_neighbours_are_searched_again_when_rows_changed_though_their_number_did_not():
    step = make_step(0)
    objective = Isometry(refresh=100, samples=1_000)
    objective.loss(step)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(1))
    shuffled = make_step(0, stretch=1.25)
    gaussians = shuffled.model.gaussians
    with torch.no_grad():
        for value in gaussians.parameters():
            value[:] = value[order]
    human = shuffled.layers.human
    human.means, human.quaternions = human.means[:, order], human.quaternions[:, order]
    human.scales = human.scales[:, order]
    stale = float(objective.loss(shuffled)["isometry_centers"])
    objective.rows_changed()
    fresh = float(objective.loss(shuffled)["isometry_centers"])
    expected = float(Isometry(refresh=1, samples=1_000).loss(shuffled)["isometry_centers"])
    assert fresh == pytest.approx(expected, rel=1e-6)
    assert stale > 1.5 * fresh


def test_state_repeats_the_same_loss():
    first, second = Isometry(refresh=100, samples=20), Isometry(refresh=100, samples=20)
    first.loss(make_step(0))
    second.load_state(first.state())
    assert float(first.loss(make_step(3))["isometry_centers"]) == float(
        second.loss(make_step(3))["isometry_centers"]
    )


@pytest.mark.parametrize("seed", range(3))
def test_compiled_change_and_its_gradients_equal_plain_torch_in_float64(seed):
    generator = torch.Generator().manual_seed(seed)
    shapes = ((90, 3), (90, 4), (90, 3), (2, 70, 3), (2, 70, 4), (2, 70, 3), (2, 70, 4, 4))
    arrays = [torch.randn(shape, generator=generator) for shape in shapes]
    arrays[2] -= 2.0
    rows = torch.stack([torch.randperm(70, generator=generator)[:5] for _ in range(40)])
    rows[0, 1] = rows[0, 0]  # a distance of zero has no direction, and no gradient
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [value.to(dtype).requires_grad_() for value in arrays]
        terms = isometry_change(rows, tuple(leaves[:3]), tuple(leaves[3:]))
        gradients = torch.autograd.grad(2 * terms[0] + 3 * terms[1], leaves)
        results.append((*terms, *gradients))
    for compiled, plain in zip(*results, strict=True):
        assert (compiled - plain).norm() < 5e-6 * plain.norm()
