"""Forward kinematics in a handful of operations, however deep the tree."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.body.tree import joint_depths


@dataclass(frozen=True, eq=False)
class Kinematics:
    """A kinematic tree with its bones, prepared for `frames`."""

    bones: Float[Tensor, "J+1 4 4"]
    """What a local rotation is added to: the shift from the parent's joint; an identity last."""
    jumps: tuple[Int[Tensor, "J+1"], ...]
    """Ancestors 1, 2, 4, ... joints up; the identity above the root."""
    below: Float[Tensor, "J J"]
    """1 where the column's joint is the row's or hangs on it, else 0."""

    @classmethod
    def of(cls, parents: Sequence[int], rest_joints: Float[Tensor, "J 3"]) -> "Kinematics":
        """``parents`` with -1 at the root, which is joint 0."""
        count, depth = len(parents), max(joint_depths(parents)) + 1
        above = torch.tensor([*(parent if parent >= 0 else count for parent in parents), count])
        bones = rest_joints.new_zeros(count + 1, 4, 4)
        places = torch.cat((rest_joints, rest_joints.new_zeros(1, 3)))
        bones[:, :3, 3] = places - places[above.to(places.device)]
        bones[:, 3, 3] = 1
        bones[count, :3, :3] = torch.eye(3)
        below = torch.eye(count)
        for joint in reversed(range(1, count)):
            below[parents[joint]] += below[joint]
        jumps = []
        for _ in range(max(1, (depth - 1).bit_length())):
            jumps.append(above.to(places.device))
            above = above[above]
        return cls(bones, tuple(jumps), below.to(places))

    def to(self, device: torch.device | str) -> "Kinematics":
        """The same on ``device``."""
        jumps = tuple(jump.to(device) for jump in self.jumps)
        return Kinematics(self.bones.to(device), jumps, self.below.to(device))

    def frames(
        self, rotations: Float[Tensor, "*T J 3 3"], transl: Float[Tensor, "*T 3"]
    ) -> Float[Tensor, "*T J 4 4"]:
        """Posed joint frames ``[R_j | t_j]`` of rotations local to the parent."""
        frames: Tensor = _Frames.apply(self, rotations, transl)
        return frames


class _Frames(torch.autograd.Function):
    """Products along the tree by doubling: each joint's chain grows 1, 2, 4, ... joints long.

    With S the sum over a joint and what hangs on it of ``dR R^T + dt t^T`` (d: the gradient of a
    frame), that of a local rotation is ``R_parent^T (S - sum(dt) t^T) R``: the frames are rigid.
    """

    @staticmethod
    def forward(ctx: Any, tree: Kinematics, rotations: Tensor, transl: Tensor) -> Tensor:
        pad = torch.nn.functional.pad
        frames = pad(rotations, (0, 1, 0, 1, 0, 1)) + tree.bones.to(rotations.dtype)
        for jump in tree.jumps:
            frames = frames.index_select(-3, jump) @ frames
        frames[..., :-1, :3, 3].add_(transl[..., None, :])
        ctx.tree = tree
        ctx.save_for_backward(frames)
        return frames[..., :-1, :, :].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        (frames,) = ctx.saved_tensors
        tree, grad = ctx.tree, upstream[0][..., :3, :]
        own = frames[..., :-1, :3, :]
        turned, places = own[..., :3], own[..., 3]
        both = torch.cat((grad @ own.mT, grad[..., 3:]), -1).flatten(-2)
        sums = (tree.below.to(both.dtype) @ both).unflatten(-1, (3, 4))
        about = torch.addcmul(sums[..., :3], sums[..., 3:], places[..., None, :], value=-1)
        above = frames[..., :3, :3].index_select(-3, tree.jumps[0][:-1])
        local = above.mT @ (about @ turned)
        return None, local, sums[..., 0, :, 3]
