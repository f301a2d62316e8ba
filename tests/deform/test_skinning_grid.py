"""Weights baked on a voxel grid: exact where the network is trilinear, near it elsewhere."""

import pytest
import torch

from evsplat.deform.skinning_grid import SkinningGrid
from evsplat.models.networks.skinning_network import SkinningNetwork

TREE = (-1, 0, 1, 1, 2, 3)


def positions(seed: int, count: int = 300) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 1.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.9


def trilinear(seed: int):
    """A field that is linear along each axis: what a grid can hold without error."""
    mix = torch.randn(8, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    def field(at: torch.Tensor) -> torch.Tensor:
        x, y, z = at.unbind(-1)
        terms = [torch.ones_like(x), x, y, z, x * y, y * z, x * z, x * y * z]
        return torch.stack(terms, -1) @ mix

    return field


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cells", [8, 37])
def test_a_trilinear_field_and_its_slope_are_exact(seed, cells):
    grid, field, at = SkinningGrid(cells), trilinear(seed), positions(seed).requires_grad_()
    grid.bake(field, at)
    upstream = torch.randn(len(at), 5, dtype=torch.float64)
    baked, exact = grid.weights(field, at), field(at)
    assert torch.allclose(baked, exact, rtol=0, atol=1e-12)
    slopes = [torch.autograd.grad((w * upstream).sum(), at)[0] for w in (baked, exact)]
    assert torch.allclose(*slopes, rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_the_error_falls_with_the_square_of_the_cells(seed):
    mix = torch.randn(3, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    at = positions(seed)

    def smooth(at: torch.Tensor) -> torch.Tensor:
        return (at @ mix).sin().softmax(-1)

    def error(cells: int) -> float:
        grid = SkinningGrid(cells)
        grid.bake(smooth, at)
        weights = grid.weights(smooth, at)
        assert float(weights.min()) >= 0
        assert torch.allclose(weights.sum(-1), torch.ones(len(at)).double(), atol=1e-12)
        return float((weights - smooth(at)).square().mean().sqrt())

    assert error(64) == pytest.approx(error(16) / 16, rel=0.2)


def test_positions_that_left_the_baked_cells_ask_the_network():
    torch.manual_seed(2)
    network, grid = SkinningNetwork(TREE, width=16, depth=2), SkinningGrid(64)
    at = 0.1 * positions(0).float()
    grid.bake(network, at)
    far = torch.cat([at[:3], at[:3] + 0.6, 1.3 + 0 * at[:1]])
    with torch.no_grad():
        assert torch.allclose(grid.weights(network, far)[3:], network(far[3:]), atol=1e-6)


def test_a_network_that_learned_is_baked_anew():
    torch.manual_seed(3)
    network, grid, at = SkinningNetwork(TREE, width=16, depth=2), SkinningGrid(8), positions(3)
    at = at.float().reshape(2, -1, 3)
    with torch.no_grad():
        before = grid.fresh_weights(network, at)
        table = grid.table
        assert torch.equal(grid.fresh_weights(network, at), before)
        assert grid.table is table
        for parameter in network.parameters():
            parameter.mul_(1.5)
        after = grid.fresh_weights(network, at)
        other = SkinningGrid(8)
        other.bake(network, at.reshape(-1, 3))
        assert torch.equal(after, other.weights(network, at.reshape(-1, 3)).reshape(after.shape))
    assert not torch.allclose(before, after, atol=1e-3)
