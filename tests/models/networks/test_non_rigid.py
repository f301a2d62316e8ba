"""The non-rigid network: start, shapes, dependence and gradients."""

import pytest
import torch

from evsplat.models.networks.non_rigid import NonRigid, NonRigidNetwork, OneBlobEncoding


def _changes(network, positions, pose):
    return network(network.encoding(0.5 * (positions + 1)), pose)


def test_start_changes_almost_nothing_unless_asked_for():
    torch.manual_seed(0)
    positions, pose = torch.rand(500, 3) * 2 - 1, torch.randn(2, 144)
    quiet = _changes(NonRigidNetwork(144), positions, pose)
    loud = _changes(NonRigidNetwork(144, last_layer_std=None), positions, pose)
    assert quiet.changes.shape == (2, 500, 3 + 3 + 3 + 16)
    assert quiet.changes[..., :3].abs().max() < 0.005  # metres
    assert loud.changes[..., :3].abs().max() > 0.03  # the centimetres of the released network
    assert quiet.changes[..., 6:9].abs().max() < 0.02


def test_output_equals_the_plain_network_on_encoding_and_pose():
    torch.manual_seed(1)
    encoding = OneBlobEncoding(8)
    network = NonRigidNetwork(10, width=16, depth=2, feature_dim=4, last_layer_std=None, bins=8)
    positions, pose = torch.rand(30, 3) * 2 - 1, torch.randn(3, 10)
    out = _changes(network, positions, pose)
    mlp = network.mlp
    for time in range(3):
        inputs = torch.cat((encoding((positions + 1) / 2), pose[time].expand(30, -1)), -1)
        hidden = inputs @ torch.cat((mlp.point_weight, mlp.time_weight), 1).T + mlp.first_bias
        for weight, bias in zip(mlp.weights, mlp.biases, strict=True):
            hidden = torch.nn.functional.leaky_relu(hidden, 0.01) @ weight.T + bias
        assert torch.allclose(out.changes[time], hidden, atol=1e-6)


def test_gradcheck():
    torch.manual_seed(2)
    network = NonRigidNetwork(3, width=5, depth=2, feature_dim=2, last_layer_std=None, bins=4)
    network = network.double()
    positions = (torch.rand(4, 3, dtype=torch.float64) * 2 - 1).requires_grad_()
    pose = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    leaves = (positions, pose, *(p for p in network.parameters() if p.numel()))

    def run(positions, pose, *_):
        return _changes(network, positions, pose).changes

    assert torch.autograd.gradcheck(run, leaves)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("used", [(0, 1, 2, 3), (0, 3), (2,)])
def test_compiled_change_of_shape_equals_plain_torch_in_float64(seed, used):
    generator = torch.Generator().manual_seed(seed)
    shapes = ((2, 1300, 13), (1300, 3), (1300, 3), (1300, 4))
    inputs = [torch.randn(shape, generator=generator) for shape in shapes]
    weights = [torch.randn(2, 1300, size, generator=generator) for size in (3, 3, 4, 9)]
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [value.detach().to(dtype).requires_grad_() for value in inputs]
        outputs = NonRigid(leaves[0]).shape(*leaves[1:])
        # The last weight is wider than what it weighs: a gradient whose rows are a part of others.
        loss = sum(
            (outputs[k] * weights[k][..., : outputs[k].shape[-1]].to(dtype)).sum() for k in used
        )
        loss.backward()
        grads = [leaf.grad for leaf in leaves if leaf.grad is not None]
        results.append([value.detach().double() for value in (*outputs, *grads)])
    plain_of = dict(enumerate(results[1]))
    for k, compiled in enumerate(results[0][:4]):
        torch.testing.assert_close(compiled, plain_of[k], rtol=1e-5, atol=1e-5)
    compiled_grads, plain_grads = results[0][4:], results[1][4:]
    compiled_grads = [grad for grad in compiled_grads if grad.abs().max() > 0]
    plain_grads = [grad for grad in plain_grads if grad.abs().max() > 0]
    for compiled, plain in zip(compiled_grads, plain_grads, strict=True):
        assert (compiled - plain).norm() < 5e-6 * plain.norm()
