"""Rotations as axis-angle vectors, matrices and quaternions (w, x, y, z)."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors (radians), differentiable at zero too."""
    x, y, z = axis_angle.unbind(-1)
    squared = (axis_angle * axis_angle).sum(-1)
    # Below the threshold the closed forms lose digits (and have no gradient at zero): Taylor.
    small = squared < (1e-2 if axis_angle.dtype == torch.float32 else 1e-4)
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    taylor_a = 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42))
    taylor_b = 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56))
    a = torch.where(small, taylor_a, angle.sin() / angle)
    b = torch.where(small, taylor_b, (1 - angle.cos()) / safe)
    xx, yy, zz = b * x * x, b * y * y, b * z * z
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    ax, ay, az = a * x, a * y, a * z
    rows = (1 - yy - zz, xy - az, xz + ay, xy + az, 1 - xx - zz, yz - ax, xz - ay, yz + ax)
    return torch.stack((*rows, 1 - xx - yy), -1).unflatten(-1, (3, 3))


def quaternion_to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
        + (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
        + (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (w, x, y, z), w >= 0, of rotation matrices.

    Each of the four components can serve as the pivot; the largest one is taken, so that no
    division is by a small number.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    # Row k is 4 q_k q, so its norm is 4 |q_k|: every row is the quaternion up to scale.
    rows = torch.stack(
        (
            torch.stack((1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01), -1),
            torch.stack((m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20), -1),
            torch.stack((m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12), -1),
            torch.stack((m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22), -1),
        ),
        -2,
    )
    pivot = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = pivot[..., None, None].expand(*pivot.shape, 1, 4)
    quaternion = torch.nn.functional.normalize(rows.gather(-2, index).squeeze(-2), dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_multiply(
    left: Float[Tensor, "*#batch 4"], right: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: the rotation ``right`` first, then ``left``."""
    aw, ax, ay, az = left.unbind(-1)
    bw, bx, by, bz = right.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        -1,
    )


def six_to_matrix(six: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices whose first two rows are ``six`` made orthonormal (Zhou et al. 2019).

    The first three numbers give the first row up to length; of the next three what is orthogonal
    to it counts.
    """
    normalize = torch.nn.functional.normalize
    first = normalize(six[..., :3], dim=-1)
    rest = six[..., 3:]
    second = normalize(rest - (first * rest).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), -2)


def matrix_to_six(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two rows, which `six_to_matrix` takes back."""
    return matrix[..., :2, :].flatten(-2)


def nearest_axis_angle(poses: Float[np.ndarray, "T *J 3"]) -> Float[np.ndarray, "T *J 3"]:
    """The same rotations, each as the axis-angle vector nearest to that of the time before.

    A rotation has one vector per whole turn about its axis; which of them a tool wrote may change
    from one frame to the next, so that anything which blends the vectors would spin the joint.
    """
    vectors = np.array(poses, np.float64)
    for time in range(1, len(vectors)):
        before, now = vectors[time - 1], vectors[time]
        angle = np.linalg.norm(now, axis=-1, keepdims=True)
        length = np.linalg.norm(before, axis=-1, keepdims=True)
        # Whole turns need no axis of their own: they keep the one of the time before.
        toward = before / np.maximum(length, 1e-12)
        axis = np.where(angle > 1e-9, now / np.maximum(angle, 1e-12), toward)
        turns = np.round(((before * axis).sum(-1, keepdims=True) - angle) / (2 * np.pi))
        vectors[time] = now + 2 * np.pi * turns * axis
    return vectors
