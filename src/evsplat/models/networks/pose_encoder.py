"""Pose vector of a skeleton: small networks along the kinematic tree (LEAP)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.tree import level_inverse, tree_levels
from evsplat.models.networks.mlp import uniform


def normalise_joints(
    rest_joints: Float[Tensor, "J 3"], rest_vertices: Float[Tensor, "V 3"]
) -> Float[Tensor, "J 3"]:
    """Rest joints in about [-1, 1]: centred on the mean vertex, one scale (method.md 1.3)."""
    centre = rest_vertices.mean(0)
    low, high = (rest_vertices - centre).aminmax()
    extent = high - low
    return 2 * (((rest_joints - centre) - low + 0.05 * extent) / extent / 1.1 - 0.5)


class PoseEncoder(nn.Module):
    """Hierarchical encoding of local joint rotations (method.md 1.4).

    A joint's feature is a two-layer network of its rotation matrix (9), rest place (3), bone length
    (1) and its parent's feature; the root's "parent" is a linear map of the whole pose. The root's
    rotation is taken as identity: the heading in the world must not enter. All joints of one level
    of the tree are computed in one batched product; parameters are stored in the order of levels.
    """

    order: Tensor
    inverse: Tensor
    constants: Tensor
    all_joints: Tensor

    def __init__(
        self, parents: Sequence[int], rest_joints: Float[Tensor, "J 3"], joint_dim: int = 6
    ) -> None:
        """``rest_joints`` in about [-1, 1], see `normalise_joints`."""
        super().__init__()
        parents = [int(parent) for parent in parents]
        joints = len(parents)
        levels = tree_levels(parents)
        self.joint_dim = joint_dim
        self.dim = joints * joint_dim
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
        inputs = 13 + joint_dim
        self.root_weight = nn.Parameter(uniform((joint_dim, 12 * joints), 12 * joints))
        self.root_bias = nn.Parameter(uniform((joint_dim,), 12 * joints))
        self.first_weight = nn.Parameter(uniform((joints, inputs, inputs), inputs))
        self.first_bias = nn.Parameter(uniform((joints, 1, inputs), inputs))
        self.second_weight = nn.Parameter(uniform((joints, inputs, joint_dim), inputs))
        self.second_bias = nn.Parameter(uniform((joints, 1, joint_dim), inputs))

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
        weight_own, weight_parent = self.first_weight.split((13, self.joint_dim), 1)
        hidden = torch.baddbmm(self.first_bias, own, weight_own).split(self.level_sizes)
        from_parent = weight_parent.split(self.level_sizes)
        second_weight = self.second_weight.split(self.level_sizes)
        second_bias = self.second_bias.split(self.level_sizes)
        features = []
        for depth, base in enumerate(hidden):
            slots = self.get_buffer(f"slots_{depth}")
            above = feature.index_select(0, slots)
            inner = torch.baddbmm(base, above, from_parent[depth]).relu()
            feature = torch.baddbmm(second_bias[depth], inner, second_weight[depth])
            features.append(feature)
        return torch.cat(features).index_select(0, self.inverse).transpose(0, 1).flatten(1)
