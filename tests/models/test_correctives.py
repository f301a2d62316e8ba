"""Correctives: what is linear in the pose comes back, and poses far off get nothing."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.models.correctives import COMPONENTS, bake_correctives

JOINTS, COUNT, POSES = 5, 60, 40


def _poses(seed: int, size: float = 0.4) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(size * rng.normal(size=(POSES * JOINTS, 3))).as_matrix()
    return torch.from_numpy(turns.reshape(POSES, JOINTS, 3, 3)).float()


def _changes(shares: np.ndarray, seed: int) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    fields = rng.normal(size=(shares.shape[1], COUNT, 4)) * [0.01, 0.01, 0.01, 0.1]
    return torch.from_numpy(np.einsum("tk,khc->thc", shares, fields)).float()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_changes_that_are_linear_in_the_pose_come_back(seed):
    """Three fields whose shares are linear in R - I: up to ridge and eight bits."""
    rotations = _poses(seed)
    features = (rotations - torch.eye(3)).flatten(1).numpy()
    shares = features @ np.random.default_rng(seed).normal(size=(features.shape[1], 3))
    changes = _changes(shares, seed)
    offsets, factors = bake_correctives(changes, rotations).at(rotations)
    got = torch.cat([offsets, factors - 1], -1)
    assert (got - changes).square().sum() < 0.03 * changes.square().sum()


def test_no_pose_gets_more_than_the_recorded_ones_and_far_ones_get_nothing():
    rotations = _poses(3)
    changes = _changes(np.random.default_rng(3).normal(size=(POSES, 4)), 3)
    baked = bake_correctives(changes, rotations)
    near = baked.shares(_poses(4, size=0.5))
    assert (near.abs() <= torch.maximum(baked.least.abs(), baked.most.abs())).all()
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    far = baked.shares(_poses(5) @ half_turn)
    assert far.abs().max() < 1e-3 * baked.most.abs().max()


def test_of_many_fields_the_largest_are_kept():
    rng = np.random.default_rng(8)
    sizes = np.array([3.0] * COMPONENTS + [0.01] * 6)
    changes = _changes(np.linalg.qr(rng.normal(size=(POSES, len(sizes))))[0] * sizes, 8)
    baked = bake_correctives(changes, _poses(8))
    assert baked.values.shape == (COMPONENTS, COUNT, 4)
    # Of another basis of the same space: what any large field is, the kept ones add up to.
    kept = (baked.values.float() * baked.steps[:, None]).flatten(1).double()
    whole = changes.flatten(1).double()
    left = whole - whole @ torch.linalg.pinv(kept) @ kept
    assert left.square().sum() < 0.01 * whole.square().sum()


def test_a_single_pose_is_kept_as_it_is():
    rotations = _poses(6)[:1]
    changes = _changes(np.ones((1, 1)), 6)
    offsets, factors = bake_correctives(changes, rotations).at(rotations)
    torch.testing.assert_close(offsets, changes[..., :3], atol=4e-4, rtol=0)
    torch.testing.assert_close(factors - 1, changes[..., 3:], atol=4e-3, rtol=0)
