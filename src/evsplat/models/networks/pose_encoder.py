"""Pose vector of a skeleton: small networks along the kinematic tree (LEAP)."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.tree import level_inverse, tree_levels
from evsplat.models.networks.mlp import uniform

JOINT_DIM = 6
"""Values of a joint's feature."""


def normalise_joints(
    rest_joints: Float[Tensor, "J 3"], rest_vertices: Float[Tensor, "V 3"]
) -> Float[Tensor, "J 3"]:
    """Rest joints in about [-1, 1]: centred on the mean vertex, one scale (3DGS-Avatar)."""
    centre = rest_vertices.mean(0)
    low, high = (rest_vertices - centre).aminmax()
    extent = high - low
    return 2 * (((rest_joints - centre) - low + 0.05 * extent) / extent / 1.1 - 0.5)


class PoseEncoder(nn.Module):
    """Hierarchical encoding of local joint rotations (3DGS-Avatar).

    A joint's feature is a two-layer network of its rotation matrix (9), rest place (3), bone length
    (1) and its parent's feature; the root's "parent" is a linear map of the whole pose. The root's
    rotation is taken as identity: the heading in the world must not enter. All joints of one level
    of the tree are computed in one batched product; parameters are stored in the order of levels.
    """

    order: Tensor
    inverse: Tensor
    constants: Tensor
    all_joints: Tensor

    def __init__(self, parents: Sequence[int], rest_joints: Float[Tensor, "J 3"]) -> None:
        """``rest_joints`` in about [-1, 1], see `normalise_joints`."""
        super().__init__()
        parents = [int(parent) for parent in parents]
        joints = len(parents)
        levels = tree_levels(parents)
        self.dim = joints * JOINT_DIM
        self.level_sizes = [len(level.joints) for level in levels]
        order = torch.cat([level.joints for level in levels])
        places = rest_joints.detach().clone()
        above = torch.tensor([max(parent, 0) for parent in parents])
        bones = places - torch.where(torch.tensor(parents)[:, None] < 0, 0.0, places[above])
        constants = torch.cat((places, bones.norm(dim=-1, keepdim=True)), -1)
        self.root = int(order[0])
        buffers = {
            "order": order,
            "inverse": level_inverse(levels),
            "constants": constants[order],
            "all_joints": places.flatten(),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        for depth, level in enumerate(levels):
            self.register_buffer(f"slots_{depth}", level.parent_slots, persistent=False)
        inputs = 13 + JOINT_DIM
        self.root_weight = nn.Parameter(uniform((JOINT_DIM, 12 * joints), 12 * joints))
        self.root_bias = nn.Parameter(uniform((JOINT_DIM,), 12 * joints))
        self.first_weight = nn.Parameter(uniform((joints, inputs, inputs), inputs))
        self.first_bias = nn.Parameter(uniform((joints, 1, inputs), inputs))
        self.second_weight = nn.Parameter(uniform((joints, inputs, JOINT_DIM), inputs))
        self.second_bias = nn.Parameter(uniform((joints, 1, JOINT_DIM), inputs))

    def forward(self, rotations: Float[Tensor, "T J 3 3"]) -> Float[Tensor, "T P"]:
        """Pose vectors (P = ``dim``, joint by joint) of local rotations; the root's is ignored."""
        times = len(rotations)
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        heading = torch.zeros(rotations.shape[1], 1, 1, dtype=torch.bool, device=rotations.device)
        heading[self.root] = True
        matrices = torch.where(heading, identity, rotations).flatten(-2)
        whole = torch.cat((matrices.flatten(1), self.all_joints.expand(times, -1)), -1)
        feature = torch.addmm(self.root_bias, whole, self.root_weight.T)[None]
        # What does not depend on the parent, for all joints at once: (joints in level order, T, .).
        own = torch.cat(
            (
                matrices.index_select(1, self.order).transpose(0, 1),
                self.constants[:, None].expand(-1, times, -1),
            ),
            -1,
        )
        weight_own, weight_parent = self.first_weight.split((13, JOINT_DIM), 1)
        features: Tensor = _DownTheTree.apply(
            [(size, self.get_buffer(f"slots_{k}")) for k, size in enumerate(self.level_sizes)],
            feature,
            torch.baddbmm(self.first_bias, own, weight_own),
            weight_parent,
            self.second_weight,
            self.second_bias,
        )
        return features.index_select(0, self.inverse).transpose(0, 1).flatten(1)


class _DownTheTree(torch.autograd.Function):
    """Features (J, T, F) of all joints, level by level from the root's; the gradient back up.

    Only what one level needs of the next is done level by level; gradients of the weights are of
    all joints at once.
    """

    @staticmethod
    def forward(
        ctx: Any,
        levels: list[tuple[int, Tensor]],
        root: Float[Tensor, "1 T F"],
        hidden: Float[Tensor, "J T I"],
        parent_weight: Float[Tensor, "J F I"],
        weight: Float[Tensor, "J I F"],
        bias: Float[Tensor, "J 1 F"],
    ) -> Float[Tensor, "J T F"]:
        above: list[Tensor] = []
        inner: list[Tensor] = []
        features: list[Tensor] = []
        feature, end = root, 0
        for size, slots in levels:
            rows = slice(end, end := end + size)
            above.append(feature.index_select(0, slots))
            inner.append(torch.baddbmm(hidden[rows], above[-1], parent_weight[rows]).relu_())
            feature = torch.baddbmm(bias[rows], inner[-1], weight[rows])
            features.append(feature)
        ctx.levels = levels
        ctx.save_for_backward(torch.cat(above), torch.cat(inner), parent_weight, weight)
        return torch.cat(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        above, inner, parent_weight, weight = ctx.saved_tensors
        lit, by_feature = inner > 0, upstream[0].clone()
        by_hidden, by_above = torch.empty_like(inner), above[:1]
        end = len(inner)
        children: Tensor | None = None
        for size, slots in reversed(ctx.levels):
            rows = slice(end - size, end)
            if children is not None:
                by_feature[rows].index_add_(0, children, by_above)
            torch.mul(by_feature[rows] @ weight[rows].mT, lit[rows], out=by_hidden[rows])
            by_above = by_hidden[rows] @ parent_weight[rows].mT
            end, children = end - size, slots
        return (
            None,
            by_above,
            by_hidden,
            above.mT @ by_hidden,
            inner.mT @ by_feature,
            by_feature.sum(1, keepdim=True),
        )
