"""Derivatives of points on a rig against finite differences; places against the body's own."""

import torch

from evsplat.body.rotations import axis_angle_to_matrix, six_to_matrix
from evsplat.posing.kinematics import SIX, SIZE, TURNS, Points, pose
from evsplat.posing.rig import default_rig


def _vectors(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    vectors = 0.4 * torch.randn(count, SIZE, generator=generator, dtype=torch.float64)
    vectors[:, 0] += 1.3
    vectors[:, 4] += 0.8
    return vectors


def _points(rig) -> Points:
    names = ["left_hand", "right_foot", "head", "root", "left_upper_arm"]
    joints = torch.tensor([rig.joint(name) for name in names])
    turners = torch.tensor(
        [rig.joint(n) for n in ("left_forearm", "right_foot", "head", "root", "chest")]
    )
    offsets = torch.linspace(-0.1, 0.2, 15, dtype=torch.float64).reshape(5, 3)
    return Points(joints, turners, offsets)


def test_jacobians_are_those_of_finite_differences():
    rig = default_rig()
    points, vectors = _points(rig), _vectors(3)
    betas = torch.linspace(-1, 1, 10, dtype=torch.float64)
    by_vector, by_shape = points.jacobian(rig, pose(rig, vectors, betas))
    step = 1e-6
    for column in range(SIZE):
        ahead, behind = vectors.clone(), vectors.clone()
        ahead[:, column] += step
        behind[:, column] -= step
        places = [points.of(pose(rig, moved, betas)) for moved in (ahead, behind)]
        slope = (places[0] - places[1]) / (2 * step)
        torch.testing.assert_close(by_vector[..., column], slope, rtol=0, atol=1e-7)
    for column in range(10):
        moved = betas.clone()
        moved[column] += 1.0
        slope = points.of(pose(rig, vectors, moved)) - points.of(pose(rig, vectors, betas))
        torch.testing.assert_close(by_shape[..., column], slope, rtol=0, atol=1e-7)


def test_joints_lie_where_the_body_has_them():
    rig = default_rig()
    vectors, betas = _vectors(4), torch.linspace(-1, 1, 10, dtype=torch.float64)
    posed = pose(rig, vectors, betas)
    root, rows = six_to_matrix(vectors[:, SIX]), vectors[:, TURNS].unflatten(1, (-1, 3))
    poses = torch.from_numpy(rig.poses(root, rows))
    body = rig.body(betas.numpy())
    transl = vectors[:, 6:9] - body.rest_joints[0].double()
    frames = body.joint_transforms(axis_angle_to_matrix(poses), transl)
    torch.testing.assert_close(frames[..., :3, 3], posed.joints, rtol=0, atol=1e-5)
