"""Rotations against scipy, and their gradients where formulas are delicate."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body.rotations import (
    axis_angle_to_matrix,
    look_like_degrees,
    matrix_to_quaternion,
    nearest_axis_angle,
    quaternion_multiply,
    quaternion_to_matrix,
)

ANGLES = [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 0.099, 0.101, 1.0, 3.14, np.pi, 5.0]


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-14), (torch.float32, 5e-7)])
def test_axis_angle_equals_scipy_from_tiny_to_beyond_pi(dtype, tolerance):
    axes = np.random.default_rng(0).normal(size=(len(ANGLES), 3))
    vectors = axes / np.linalg.norm(axes, axis=1, keepdims=True) * np.array(ANGLES)[:, None]
    expected = Rotation.from_rotvec(vectors).as_matrix()
    result = axis_angle_to_matrix(torch.tensor(vectors, dtype=dtype)).double().numpy()
    assert np.abs(result - expected).max() < tolerance


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.0099, 0.0101, 2.0])
def test_axis_angle_gradient_is_right_at_zero_too(angle):
    vector = torch.tensor([0.36, -0.48, 0.8], dtype=torch.float64) * angle
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (vector.requires_grad_(),))


def test_quaternions_equal_scipy_and_round_trip():
    rotation = Rotation.random(500, random_state=1)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    matrices = np.concatenate((rotation.as_matrix(), half_turns.as_matrix(), np.eye(3)[None]))
    quaternions = matrix_to_quaternion(torch.tensor(matrices))
    assert (quaternions[:, 0] >= 0).all()
    assert np.allclose(quaternion_to_matrix(quaternions).numpy(), matrices, atol=1e-14)
    expected = rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    assert np.allclose(quaternions[:500].numpy(), expected, atol=1e-14)


def test_quaternion_product_composes_right_first():
    a, b = Rotation.random(50, random_state=2), Rotation.random(50, random_state=3)
    to_wxyz = [3, 0, 1, 2]
    product = quaternion_multiply(
        torch.tensor(a.as_quat()[:, to_wxyz]), torch.tensor(b.as_quat()[:, to_wxyz])
    )
    assert np.allclose(quaternion_to_matrix(product).numpy(), (a * b).as_matrix(), atol=1e-14)
    assert torch.allclose(quaternion_to_matrix(3.7 * product), quaternion_to_matrix(product))


def test_poses_in_degrees_are_told_from_those_that_go_round(rng: np.random.Generator):
    poses = 0.5 * rng.normal(size=(40, 24, 3))
    poses[:, 0, 2] += np.linspace(0, 60, 40)  # a pirouette
    poses[:, 16] = np.linspace(0, 3 * np.pi, 40)[:, None] * (0.6, 0.0, 0.8)
    poses = nearest_axis_angle(poses)
    assert np.linalg.norm(poses[:, 16], axis=-1).max() > 2 * np.pi
    assert look_like_degrees(poses) is None
    degrees = np.degrees(poses)
    largest = np.linalg.norm(degrees[:, 1:], axis=-1).max()
    assert look_like_degrees(degrees) == (
        f"joints turned by up to {largest:.0f} radians in 40 of 40 poses"
    )
    assert look_like_degrees(degrees[:, :1]) is None
    spoilt = poses.copy()
    spoilt[:3] = degrees[:3]
    assert look_like_degrees(spoilt) is None
