"""The hierarchical softmax against a literal transcription of SMPL's rule, and on any tree."""

import math

import pytest
import torch

from evsplat.body import bounding_box, default_body
from evsplat.body.canonical import SMPL_PARENTS
from evsplat.errors import DataError
from evsplat.models.networks.skinning_network import HierarchicalSoftmax, SkinningNetwork


def smpl_rule(x):
    """3DGS-Avatar's rule for 24 joints from 25 logits, step by step (3DGS-Avatar)."""
    s, w = torch.sigmoid(x), [torch.empty(0)] * 24
    gate = s[:, 0]
    w[0] = 1 - gate
    first = torch.softmax(x[:, 1:4], -1)
    w[1], w[2], w[3] = (gate * first[:, k] for k in range(3))

    def hand_down(parents, children):
        for parent, child in zip(parents, children, strict=True):
            w[child] = w[parent] * s[:, child]
            w[parent] = w[parent] * (1 - s[:, child])

    hand_down((1, 2, 3), (4, 5, 6))
    hand_down((4, 5, 6), (7, 8, 9))
    hand_down((7, 8), (10, 11))
    chest = torch.softmax(x[:, 12:15], -1)
    mass = w[9] * s[:, 24]
    w[9] = w[9] * (1 - s[:, 24])
    w[12], w[13], w[14] = (mass * chest[:, k] for k in range(3))
    hand_down((12,), (15,))
    hand_down((13, 14), (16, 17))
    hand_down((16, 17), (18, 19))
    hand_down((18, 19), (20, 21))
    hand_down((20, 21), (22, 23))
    return torch.stack(w, -1)


def any_tree_rule(parents, x):
    """The rule of the docstring for any tree, recursively."""
    joints, root = len(parents), list(parents).index(-1)
    children = [[c for c in range(joints) if parents[c] == j] for j in range(joints)]
    forks = [j for j in range(joints) if j != root and len(children[j]) > 1]
    w = [None] * joints

    def visit(joint, mass):
        below = children[joint]
        if not below:
            w[joint] = mass
            return
        if joint == root or len(below) > 1:
            gate = x[..., root if joint == root else joints + forks.index(joint)].sigmoid()
            shares = torch.softmax(x[..., below], -1)
            passed = [mass * gate * shares[..., k] for k in range(len(below))]
        else:
            gate = x[..., below[0]].sigmoid()
            passed = [mass * gate]
        w[joint] = mass * (1 - gate)
        for child, amount in zip(below, passed, strict=True):
            visit(child, amount)

    visit(root, torch.ones_like(x[..., 0]))
    return torch.stack(w, -1)


TREES = [
    SMPL_PARENTS,
    (-1, 0, 1, 2, 3, 4, 0, 6, 7, 8, 9, 10, 11, 12, 12, 14, 8, 16, 17, 8, 19, 20, 21, 22, 22)
    + (24, 0, 26, 27, 28, 29),  # the CMU rig
    (2, 4, -1, 2, 3, 0, 1, 3, 3),  # not sorted
    (-1, 0, 1, 1),
    (-1, 0),
    (-1,),
]


@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_smpl_tree_gives_the_24_joint_rule(scale):
    logits = scale * torch.randn(300, 25, generator=torch.Generator().manual_seed(0)).double()
    softmax = HierarchicalSoftmax(SMPL_PARENTS)
    assert softmax.logits == 25
    assert (softmax(logits) - smpl_rule(logits)).abs().max() < 1e-12


@pytest.mark.parametrize("parents", TREES, ids=[f"{len(tree)} joints" for tree in TREES])
def test_any_tree_follows_the_recursive_rule_and_sums_to_one(parents):
    softmax = HierarchicalSoftmax(parents)
    logits = 4 * torch.randn(2, 50, softmax.logits, generator=torch.Generator().manual_seed(1))
    logits = logits.double()
    weights = softmax(logits)
    assert (weights - any_tree_rule(parents, logits)).abs().max() < 1e-12
    assert (weights.sum(-1) - 1).abs().max() < 1e-12
    assert torch.allclose(softmax.float()(logits.float()).sum(-1), torch.ones(2, 50), atol=2e-6)


@pytest.mark.parametrize("parents", TREES[:4], ids=[f"{len(tree)} joints" for tree in TREES[:4]])
def test_softmax_gradcheck(parents):
    softmax = HierarchicalSoftmax(parents)
    logits = torch.randn(3, softmax.logits, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(softmax, (logits,))


def test_huge_logits_give_no_nan_in_values_or_gradients():
    softmax = HierarchicalSoftmax(SMPL_PARENTS)
    logits = (300 * torch.randn(200, 25)).requires_grad_()
    weights = softmax(logits)
    (weights**2).sum().backward()
    assert torch.allclose(weights.sum(-1), torch.ones(200), atol=1e-3)
    assert torch.isfinite(weights).all() and torch.isfinite(logits.grad).all()


def test_what_is_no_tree_is_refused():
    with pytest.raises(DataError, match="2 roots"):
        HierarchicalSoftmax((-1, -1))


def test_network_has_the_papers_size_and_its_gradients_check():
    network = SkinningNetwork(SMPL_PARENTS)
    assert abs(sum(p.numel() for p in network.parameters()) - 53_000) < 400
    weights = network(torch.rand(2, 7, 3) * 2 - 1)
    assert weights.shape == (2, 7, 24)
    assert torch.allclose(weights.sum(-1), torch.ones(2, 7), atol=1e-6)
    small = SkinningNetwork(TREES[3], width=5, depth=2).double()
    positions = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    leaves = (positions, *(p for p in small.parameters() if p.numel()))
    assert torch.autograd.gradcheck(lambda p, *_: small(p), leaves)


def test_network_learns_the_weights_of_a_body():
    torch.manual_seed(0)
    body = default_body()
    low, high = bounding_box(body)
    samples = body.sample_surface(1_024, torch.Generator().manual_seed(0))
    positions = 2 * (samples.points - low) / (high - low) - 1
    network = SkinningNetwork(body.parents.tolist(), width=64, depth=3)
    optimiser = torch.optim.Adam(network.parameters(), 5e-3)
    losses = []
    for _ in range(120):
        loss = ((network(positions) - samples.weights) ** 2).sum(-1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.15 * losses[0]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("joints", [1, 2, 7, 31])
def test_compiled_softmax_and_its_gradient_equal_plain_torch_in_float64(seed, joints):
    generator = torch.Generator().manual_seed(seed)
    parents = [-1] + [int(torch.randint(j, (), generator=generator)) for j in range(1, joints)]
    softmax = HierarchicalSoftmax(parents)
    logits = 5 * torch.randn(3, 13, softmax.logits, generator=generator)
    upstream = torch.randn(3, 13, joints, generator=generator)
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = logits.detach().to(dtype).requires_grad_()
        weights = softmax(leaf)
        (gradient,) = torch.autograd.grad(weights, leaf, upstream.to(dtype))
        results.append((weights.detach().double(), gradient.double()))
    for compiled, plain in zip(*results, strict=True):
        assert (compiled - plain).norm() <= 2e-6 * plain.norm()


def test_compiled_softmax_of_no_number_is_none():
    softmax = HierarchicalSoftmax((-1, 0, 0, 1))
    logits = torch.zeros(5, softmax.logits)
    logits[2] = math.nan
    weights = softmax(logits)
    assert weights[2].isnan().any() and not weights[[0, 1, 3, 4]].isnan().any()
