"""Skinning weights in turns: the network's own after a round, its gradient in the mean."""

import pytest
import torch

from evsplat.models.networks.skinning_network import SkinningTurns


def make(seed: int, rows: int = 23) -> tuple[torch.nn.Module, torch.Tensor]:
    torch.manual_seed(seed)
    network = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Linear(8, 5))
    return network.double(), torch.randn(rows, 3, dtype=torch.float64)


@pytest.mark.parametrize("turns", [1, 3, 4])
def test_a_round_after_a_change_gives_what_the_network_gives(turns):
    network, positions = make(turns)
    turned = SkinningTurns(turns)
    turned.weights(network, positions)
    with torch.no_grad():
        network[0].weight.mul_(1.5)
    for _ in range(turns):
        weights = turned.weights(network, positions)
    assert torch.allclose(weights, network(positions), rtol=0, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_the_mean_gradient_over_a_round_is_that_of_all_rows(seed):
    network, positions = make(seed)
    positions.requires_grad_()
    upstream = torch.randn(23, 5, dtype=torch.float64)
    leaves = [positions, *network.parameters()]
    turns = SkinningTurns(4)
    turns.weights(network, positions)
    total = [torch.zeros_like(leaf) for leaf in leaves]
    for _ in range(4):
        loss = (turns.weights(network, positions) * upstream).sum()
        for sum_, gradient in zip(total, torch.autograd.grad(loss, leaves), strict=True):
            sum_ += gradient / 4
    expected = torch.autograd.grad((network(positions) * upstream).sum(), leaves)
    for mean, gradient in zip(total, expected, strict=True):
        assert torch.allclose(mean, gradient, rtol=1e-12, atol=1e-12)


def test_changed_rows_are_looked_up_at_once():
    network, positions = make(0)
    turns = SkinningTurns(4)
    turns.weights(network, positions)
    other = positions.flip(0)
    turns.rows_changed()
    assert torch.equal(turns.weights(network, other), network(other))
    grown = torch.cat([positions, positions[:2]])
    assert torch.equal(turns.weights(network, grown), network(grown))


def test_a_resume_goes_on_with_the_same_rows():
    network, positions = make(1)
    turns, resumed = SkinningTurns(4), SkinningTurns(4)
    for _ in range(3):
        turns.weights(network, positions)
    resumed.load_state(turns.state())
    with torch.no_grad():
        network[0].weight.mul_(2.0)
    expected = turns.weights(network, positions)
    assert torch.equal(resumed.weights(network, positions), expected)
