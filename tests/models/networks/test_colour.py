"""Colour networks: what they depend on, their sizes, gradients and the view jitter."""

import math

import pytest
import torch

from evsplat.camera import Camera
from evsplat.models.networks.colour import (
    HumanColour,
    SceneColour,
    beside_basis,
    scene_rgb,
    view_directions,
    view_jitter,
)
from evsplat.models.networks.spherical_harmonics import sh_basis


def unit(*shape, seed=0, dtype=torch.float32):
    points = torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(points, dim=-1).to(dtype)


def test_human_colour_is_the_79_input_network():
    torch.manual_seed(0)
    network = HumanColour()
    assert sum(p.numel() for p in network.parameters()) == 79 * 64 + 64 + 64 * 65 + 65 * 3
    features, directions = torch.randn(20, 32), unit(2, 20, 3)
    nonrigid, latent = torch.randn(2, 20, 16), torch.randn(2, 16)
    colour = network(features, directions, nonrigid, latent)
    mlp = network.mlp
    weight = torch.cat((mlp.point_weight, mlp.both_weight, mlp.time_weight), 1)
    for time in range(2):
        hidden = torch.cat(
            (features, sh_basis(directions[time]), nonrigid[time], latent[time].expand(20, -1)), -1
        )
        hidden = hidden @ weight.T + mlp.first_bias
        for w, b in zip(mlp.weights, mlp.biases, strict=True):
            hidden = torch.nn.functional.leaky_relu(hidden, 0.01) @ w.T + b
        assert torch.allclose(colour[time], hidden.sigmoid(), atol=1e-6)


def test_human_colour_gradcheck():
    torch.manual_seed(1)
    network = HumanColour(3, 2, 4, width=6).double()
    d = torch.float64
    leaves = [
        torch.randn(4, 3, dtype=d),
        unit(2, 4, 3, dtype=d),
        torch.randn(2, 4, 2, dtype=d),
        torch.randn(2, 4, dtype=d),
    ]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(lambda *a: network(*a[:4]), (*leaves, *network.parameters()))


def test_scene_colour_sees_the_direction_unless_it_is_hidden():
    torch.manual_seed(2)
    network, features = SceneColour(), torch.randn(9, 32)
    one, other = unit(9, 3, seed=1), unit(9, 3, seed=2)
    assert (network(features, one) - network(features, other)).abs().max() > 1e-3
    assert sum(p.numel() for p in network.parameters()) == 47 * 64 + 64 + 64 * 65 + 65 * 3
    # A direction of zero says nothing: the colour is that of the features alone.
    mlp = network.mlp
    hidden = features @ mlp.point_weight[:, :32].T + mlp.first_bias
    for w, b in zip(mlp.weights, mlp.biases, strict=True):
        hidden = torch.nn.functional.leaky_relu(hidden, 0.01) @ w.T + b
    assert torch.allclose(network(features, torch.zeros(9, 3)), hidden.sigmoid(), atol=1e-6)


def test_scene_colour_gradcheck():
    network = SceneColour(feature_dim=3, width=5).double()
    leaves = [torch.randn(4, 3, dtype=torch.float64), unit(4, 3, dtype=torch.float64)]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    parameters = [p for p in network.parameters() if p.numel()]
    assert torch.autograd.gradcheck(lambda f, d, *_: network(f, d), (*leaves, *parameters))


def test_view_jitter_is_a_rotation_with_the_released_codes_third_angle():
    generator = torch.Generator().manual_seed(0)
    literal = torch.stack([view_jitter(generator) for _ in range(400)])
    symmetric = torch.stack([view_jitter(generator, symmetric=True) for _ in range(400)])
    for rotations in (literal, symmetric):
        assert torch.allclose(rotations @ rotations.mT, torch.eye(3).expand(400, 3, 3), atol=1e-6)
        assert torch.allclose(torch.linalg.det(rotations), torch.ones(400), atol=1e-6)

    def third(rotations):
        return torch.atan2(rotations[:, 1, 0], rotations[:, 0, 0])  # of z @ y @ x

    inside = literal[:, 2, 0].abs() < 0.999  # at 90 degrees about y the angles are not unique
    assert (third(literal)[inside] > -1e-4).all()
    assert (third(literal)[inside] < math.pi / 4 + 1e-4).all()
    assert (third(symmetric) < 0).float().mean() > 0.3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("values_first", [False, True])
def test_compiled_basis_beside_values_equals_plain_torch_in_float64(seed, values_first):
    directions = unit(2, 37, 3, seed=seed)
    values = torch.randn(2, 37, 5, generator=torch.Generator().manual_seed(seed))
    weights = torch.randn(2, 37, 20, generator=torch.Generator().manual_seed(seed + 9))
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = values.detach().to(dtype).requires_grad_()
        joined = beside_basis(directions.to(dtype), leaf, values_first=values_first)
        (joined * weights.to(dtype)).sum().backward()
        results.append((joined.detach().double(), leaf.grad.double()))
    for compiled, plain in zip(*results, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("turned", [False, True])
def test_compiled_view_directions_equal_plain_torch_in_float64(seed, turned):
    generator = torch.Generator().manual_seed(seed)
    positions, center = torch.randn(2, 41, 3, generator=generator), torch.randn(3)
    positions[1, 7] = center  # no direction at all
    more = ()
    if turned:
        more = torch.randn(2, 41, 4, 4, generator=generator), view_jitter(generator)
    compiled = view_directions(positions, center, *more)
    plain = view_directions(positions.double(), center.double(), *(m.double() for m in more))
    torch.testing.assert_close(compiled.double(), plain, rtol=1e-4, atol=1e-5)
    assert not compiled.requires_grad and (compiled[1, 7] == 0).all()


@pytest.mark.parametrize("hide", [False, True])
def test_a_scenes_colours_are_asked_for_where_the_pictures_reach_alone(hide):
    torch.manual_seed(1)
    network, features = SceneColour(), torch.randn(9, 32)
    camera = Camera(32, 24, torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]]), torch.eye(4))
    means = torch.tensor([0.0, 0.0, 4.0]) + 0.3 * torch.randn(9, 3)
    means[::2] *= -1  # behind the camera
    scales, center = torch.full((9, 3), 0.01), torch.tensor([0.2, -0.1, 0.3])
    found = scene_rgb(network, features, means, scales, center, shown=[camera], hide_direction=hide)
    whole = scene_rgb(network, features, means, scales, center, shown=[], hide_direction=hide)
    directions = torch.nn.functional.normalize(means - center, dim=-1) * (not hide)
    torch.testing.assert_close(whole, network(features, directions), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[1::2], whole[1::2], atol=1e-6, rtol=0)
    assert found.shape == (9, 3) and not found[::2].any()
