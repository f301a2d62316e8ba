"""The split MLP against one on concatenated inputs, and the compiled one against float64."""

import pytest
import torch
from torch import nn

from evsplat import _native
from evsplat.models.networks.mlp import PointMLP


def plain(network, point, time=None, both=None, hiddens=None):
    """All inputs repeated and concatenated, layer by layer; what leaves hidden ones into a list."""
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
        if hiddens is not None:
            hiddens.append(hidden)
        hidden = nn.functional.leaky_relu(hidden, 0.01) @ weight.T + bias
    return hidden


def off_the_kink(network, arguments, within=1e-6):
    """1 for outputs whose slope rounding does not change: no hidden value is that near to 0."""
    hiddens = []
    with torch.no_grad():
        plain(network, *arguments, hiddens=hiddens)
    nearest = torch.stack([hidden.abs().amin(-1, keepdim=True) for hidden in hiddens]).amin(0)
    return nearest > within


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


def both_ways(network, arguments, counted=1.0):
    """Output and gradients of the network and of the plain one; only ``counted`` outputs teach."""
    leaves = [leaf for leaf in (*arguments, *network.parameters()) if leaf is not None]
    leaves = [leaf for leaf in leaves if leaf.requires_grad and leaf.numel()]
    results = []
    for function in (network, lambda *a: plain(network, *a)):
        output = function(*arguments)
        generator = torch.Generator().manual_seed(output.numel())
        upstream = torch.randn(output.shape, generator=generator).to(output) * counted
        gradients = torch.autograd.grad(output, leaves, upstream, allow_unused=True)
        results.append([output, *(g for g in gradients if g is not None)])
    assert len(results[0]) == len(results[1])
    return results


KINDS = ["point", "point time", "point both", "point time both"]


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_equal_the_network_on_concatenated_inputs(kind):
    network, arguments = inputs(kind)
    for split, expected in zip(*both_ways(network, arguments), strict=True):
        assert torch.allclose(split, expected, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck(kind):
    network, arguments = inputs(kind, points=5, times=2)
    leaves = [leaf for leaf in (*arguments, *network.parameters()) if leaf is not None]
    leaves = [leaf for leaf in leaves if leaf.numel()]
    assert torch.autograd.gradcheck(lambda *_: network(*arguments), leaves)


SIZES = [
    ((48, 144, 0), 128, 3, 25),  # the non-rigid network
    ((3, 0, 0), 128, 4, 35),  # the skinning network
    ((32, 16, 31), 64, 2, 3),  # the person's colour
    ((47, 0, 0), 64, 2, 3),  # the scene's colour
    ((5, 2, 3), 7, 1, 2),  # no multiple of anything
    ((5, 2, 3), 88, 2, 2),  # panels whose sums are made side by side, and some more
]


def sized(inputs_of, width, depth, out, points):
    """A network of these sizes with random arguments, in float32 and the same in float64."""
    torch.manual_seed(points)
    network = PointMLP(*inputs_of, width=width, depth=depth, out=out)
    times = 3 if inputs_of[1] or inputs_of[2] else 1
    arguments = [
        torch.randn(points, inputs_of[0]).requires_grad_(),
        torch.randn(times, inputs_of[1]).requires_grad_() if inputs_of[1] else None,
        torch.randn(times, points, inputs_of[2]).requires_grad_() if inputs_of[2] else None,
    ]
    exact = PointMLP(*inputs_of, width=width, depth=depth, out=out).double()
    exact.load_state_dict(network.state_dict())
    doubles = [None if a is None else a.detach().double().requires_grad_() for a in arguments]
    return network, arguments, exact, doubles


@pytest.mark.parametrize("level", _native.levels())
@pytest.mark.parametrize(("inputs_of", "width", "depth", "out"), SIZES)
@pytest.mark.parametrize("points", [1, 95, 96, 97, 1000])
def test_native_values_and_gradients_equal_those_in_float64(
    inputs_of, width, depth, out, points, level, monkeypatch
):
    monkeypatch.setenv("EVSPLAT_ISA", level)
    assert_near_float64(inputs_of, width, depth, out, points)


def assert_near_float64(inputs_of, width, depth, out, points):
    # On AMX a float is the sum of two bfloat16, 16 binary digits of its 24.
    far, near_zero = (2e-5, 1e-5) if _native.level() == "amx" else (3e-6, 1e-6)
    network, arguments, exact, doubles = sized(inputs_of, width, depth, out, points)
    counted = off_the_kink(exact, doubles, near_zero)
    assert counted.double().mean() > 0.95
    native, _ = both_ways(network, arguments, counted)
    _, expected = both_ways(exact, doubles, counted)
    for value, truth in zip(native, expected, strict=True):
        assert (value - truth).norm() < far * truth.norm()


def test_on_amx_what_is_no_number_and_what_is_endless_is_not_lost(monkeypatch):
    if "amx" not in _native.levels():
        pytest.skip("this processor has no amx")
    monkeypatch.setenv("EVSPLAT_ISA", "amx")
    torch.manual_seed(0)
    network = PointMLP(20, 0, 0, width=40, depth=2, out=3)
    for value in (torch.nan, torch.inf, -torch.inf):
        point = torch.randn(50, 20)
        point[33, 7] = value
        output = network(point.requires_grad_())[0]
        assert (~output.isfinite()).all(-1).nonzero().flatten().tolist() == [33]
        gradient = torch.ones(50, 3)
        gradient[12, 1] = value
        leaf = torch.randn(50, 20, requires_grad=True)
        network(leaf)[0].backward(gradient)
        assert (~leaf.grad.isfinite()).any(-1).nonzero().flatten().tolist() == [12]
        assert not network.biases[-1].grad.isfinite().all()
        network.zero_grad()


def test_native_results_do_not_depend_on_the_number_of_threads():
    torch.manual_seed(0)
    network = PointMLP(48, 144, 0, width=128, depth=3, out=25)
    arguments = [torch.randn(2_000, 48).requires_grad_(), torch.randn(2, 144), None]
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(both_ways(network, arguments)[0])
    finally:
        torch.set_num_threads(threads)
    # Products of plain torch (time's) may differ, so only what the native part gives is compared.
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("level", ["amx", "avx512", "avx2", "portable"])
def test_every_simd_level_gives_what_float64_gives(level, monkeypatch):
    if level not in _native.levels():
        pytest.skip(f"this processor has no {level}")
    monkeypatch.setenv("EVSPLAT_ISA", level)
    assert _native.level() == level
    assert_near_float64((9, 4, 5), 23, 2, 6, points=130)


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
