"""Rotations as axis-angle vectors, matrices and quaternions (w, x, y, z)."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.devices import constant

_TOO_FAR_RAD = 4 * np.pi
"""No joint turns twice round against its parent; vectors that go on beyond half a turn, as those of
`nearest_axis_angle`, stay below."""
_IDENTITY = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors (radians), differentiable at zero too, once."""
    matrices: Tensor = _Exponential.apply(axis_angle)
    return matrices


class _Exponential(torch.autograd.Function):
    """Rodrigues' formula, and its gradient by the rotations' left Jacobian.

    A dozen operations each way: a few hundred numbers cost a GPU nothing but its launches.
    """

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        identity = constant(_IDENTITY, vectors)
        cross = torch.linalg.cross(identity.expand(*vectors.shape, 3), vectors[..., None, :])
        twice = cross @ cross
        angle = vectors.norm(dim=-1)[..., None, None]
        whole_and_half = constant(((1 / torch.pi, 0.5 / torch.pi),), vectors)
        first, half = torch.sinc(angle * whole_and_half).split(1, -1)
        second = half.square()  # twice the factor
        matrices = torch.addcmul(identity, first, cross).addcmul_(second, twice, value=0.5)
        ctx.save_for_backward(vectors, angle, first, second, matrices)
        return matrices

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        vectors, angle, first, second, matrices = ctx.saved_tensors
        turned = upstream[0] @ matrices.mT
        _, xy, xz, yx, _, yz, zx, zy, _ = (turned - turned.mT).flatten(-2).unbind(-1)
        torque = torch.stack((zy, xz, yx), -1)
        # (angle - sin) / angle^3; where that is nothing divided by nothing, so is what it weighs.
        third = (1 - first) / angle.square().clamp_min(torch.finfo(angle.dtype).tiny)
        around = torch.linalg.cross(vectors, torque)
        again = torch.linalg.cross(vectors, around)
        grad = torch.addcmul(torque, second[..., 0], around, value=-0.5)
        return torch.addcmul(grad, third[..., 0], again)


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


def look_like_degrees(poses: Float[np.ndarray, "T J 3"]) -> str | None:
    """What says that axis-angle vectors are in degrees, in words; None where nothing does.

    Half of the poses then have a joint that is turned further than any joint can be. The root,
    which may turn round and round, says nothing.
    """
    angles = np.linalg.norm(np.asarray(poses, np.float64)[:, 1:], axis=-1)
    if not angles.size:
        return None
    far = int((angles.max(1) > _TOO_FAR_RAD).sum())
    if 2 * far < len(angles):
        return None
    return f"joints turned by up to {angles.max():.0f} radians in {far} of {len(angles)} poses"
