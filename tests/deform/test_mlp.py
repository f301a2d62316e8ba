"""The chunked MLP against the plain one on concatenated inputs."""

import pytest
import torch
from torch import nn

from evsplat.deform import mlp as mlp_module
from evsplat.deform.mlp import PointMLP


def plain(network, point, time=None, both=None):
    """All inputs repeated and concatenated, layer by layer."""
    times = len(time) if time is not None else len(both) if both is not None else 1
    parts, weights = [point.expand(times, -1, -1)], [network.point_weight]
    if time is not None:
        parts.append(time[:, None].expand(-1, len(point), -1))
        weights.append(network.time_weight)
    if both is not None:
        parts.append(both)
        weights.append(network.both_weight)
    hidden = torch.cat(parts, -1) @ torch.cat(weights, 1).T + network.first_bias
    for weight, bias in zip(network.weights, network.biases, strict=True):
        hidden = nn.functional.leaky_relu(hidden, 0.01) @ weight.T + bias
    return hidden


def inputs(kind, dtype=torch.float64, points=13, times=3):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator).to(dtype).requires_grad_()

    time = draw(times, 4) if "time" in kind else None
    both = draw(times, points, 5) if "both" in kind else None
    sizes = (3, 4 if time is not None else 0, 5 if both is not None else 0)
    torch.manual_seed(1)
    network = PointMLP(*sizes, width=7, depth=3, out=2).to(dtype)
    return network, [tensor for tensor in (draw(points, 3), time, both)]


KINDS = ["point", "point time", "point both", "point time both"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [1, 8, 100_000])
def test_values_and_gradients_equal_the_plain_network_whatever_the_chunks(kind, rows, monkeypatch):
    monkeypatch.setattr(mlp_module, "_ROWS", rows)
    network, arguments = inputs(kind)
    leaves = [leaf for leaf in (*arguments, *network.parameters()) if leaf is not None]
    results = []
    for function in (network, lambda *a: plain(network, *a)):
        output = function(*arguments)
        upstream = torch.linspace(-1, 1, output.numel(), dtype=output.dtype).view_as(output)
        gradients = torch.autograd.grad(output, leaves, upstream, allow_unused=True)
        results.append([output, *(g for g in gradients if g is not None and g.numel())])
    assert len(results[0]) == len(results[1])
    for chunked, expected in zip(*results, strict=True):
        assert torch.allclose(chunked, expected, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck(kind, monkeypatch):
    monkeypatch.setattr(mlp_module, "_ROWS", 12)
    network, arguments = inputs(kind, points=5, times=2)
    leaves = [leaf for leaf in (*arguments, *network.parameters()) if leaf is not None]
    leaves = [leaf for leaf in leaves if leaf.numel()]
    assert torch.autograd.gradcheck(lambda *_: network(*arguments), leaves)


def test_transposed_inputs_give_the_same():
    network, (point, _, _) = inputs("point")
    transposed = point.detach().T.contiguous().T.requires_grad_()
    network(transposed).sum().backward()
    network(point).sum().backward()
    assert torch.allclose(transposed.grad, point.grad, atol=1e-12)


def test_no_points_and_no_gradient_are_fine():
    network, _ = inputs("point time")
    time = torch.randn(2, 4, dtype=torch.float64)
    assert network(torch.empty(0, 3, dtype=torch.float64), time).shape == (2, 0, 2)
    with torch.no_grad():
        assert network(torch.zeros(4, 3, dtype=torch.float64), time).requires_grad is False


def test_start_is_that_of_linear_layers_and_the_last_can_be_near_zero():
    torch.manual_seed(0)
    network = PointMLP(30, 50, 20, width=200, depth=2, out=300, last_std=1e-4)
    for weight in (network.point_weight, network.time_weight, network.both_weight):
        assert abs(weight.abs().max().item() - 0.1) < 1e-3  # 1 / sqrt(100 inputs together)
        assert abs(weight.std().item() - 0.1 / 3**0.5) < 2e-3
    assert abs(network.weights[0].abs().max().item() - 200**-0.5) < 1e-4
    assert abs(network.weights[-1].std().item() - 1e-4) < 1e-5
    assert (network.biases[-1] == 0).all()


def test_bfloat16_stays_near_float32_in_values_and_gradients():
    torch.manual_seed(0)
    exact = PointMLP(48, 144, 0, width=128, depth=3, out=25)
    fast = PointMLP(48, 144, 0, width=128, depth=3, out=25, precision="bfloat16")
    fast.load_state_dict(exact.state_dict())
    point, time = torch.rand(3_000, 48), torch.randn(2, 144)
    upstream = torch.randn(2, 3_000, 25)
    results = []
    for network in (exact, fast):
        leaf = point.clone().requires_grad_()
        output = network(leaf, time)
        output.backward(upstream)
        gradients = [p.grad for p in network.parameters() if p.numel()]
        results.append([output.detach(), leaf.grad, *gradients])
        assert all(value.dtype == torch.float32 for value in results[-1])
    for index, (reference, value) in enumerate(zip(*results, strict=True)):
        # 8 bits round by up to 0.4 %; a gradient also errs where rounding moves an argument of the
        # leaky ReLU across zero (upstream gradients are random here, which is the worst case).
        limit = 0.01 if index == 0 else 0.12
        assert (value - reference).norm() < limit * reference.norm()


def test_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="precision is 'float16', expected float32 or bfloat16"):
        PointMLP(3, 0, 0, width=4, depth=1, out=1, precision="float16")
