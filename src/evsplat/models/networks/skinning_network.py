"""Skinning weights by an MLP and a hierarchical softmax, and a part of them at each step."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.tree import joint_depths
from evsplat.compiled import native, runs_native
from evsplat.models.networks.mlp import PointMLP

Network = Callable[[Float[Tensor, "M C"]], Float[Tensor, "M J"]]


class HierarchicalSoftmax(nn.Module):
    """Weights over the joints of any tree by passing mass from the root down (3DGS-Avatar).

    The root starts with mass one. A joint with one child passes it ``sigmoid(l_child)`` of its mass
    and keeps the rest. The root, and any joint with several children, passes on ``sigmoid(gate)``
    of its mass, divided by ``softmax(l_children)``. The root's gate is its own logit; the other
    gates follow the J logits in the order of their joints. For SMPL this is the 25-logit rule of
    3DGS-Avatar. All joints are computed at once: along a path logarithms of shares add up, so that
    the logarithm of the weights is a fixed matrix times the logarithms of all shares.
    """

    gate_paths: Tensor
    logit_paths: Tensor
    child_paths: Tensor
    siblings: Tensor
    sibling_mask: Tensor
    sibling_places: Tensor

    def __init__(self, parents: Sequence[int]) -> None:
        super().__init__()
        joints = len(parents)
        joint_depths(parents)  # refuses what is not a tree
        children = [[c for c, parent in enumerate(parents) if parent == j] for j in range(joints)]
        root = list(parents).index(-1)
        gates = {root: root} if children[root] else {}
        for joint in range(joints):
            if joint != root and len(children[joint]) > 1:
                gates[joint] = joints + len(gates) - 1
        self.logits = joints + sum(joint != root for joint in gates)
        families = [children[joint] for joint in gates]
        most = max((len(family) for family in families), default=0)
        places = {
            child: slot * most + order
            for slot, family in enumerate(families)
            for order, child in enumerate(family)
        }
        # log sigmoid(-l) = log sigmoid(l) - l: "keeps the rest" needs no second sigmoid.
        sigmoid = torch.zeros(self.logits, joints)
        logit = torch.zeros(self.logits, joints)
        child = torch.zeros(len(places), joints)
        column = {joint: index for index, joint in enumerate(places)}
        for joint in range(joints):
            keep = gates.get(joint, children[joint][0] if children[joint] else None)
            if keep is not None:
                sigmoid[keep, joint] += 1
                logit[keep, joint] -= 1
            member = joint
            while (above := parents[member]) >= 0:
                sigmoid[gates.get(above, member), joint] += 1
                if above in gates:
                    child[column[member], joint] += 1
                member = above
        padded = [family + [family[0]] * (most - len(family)) for family in families]
        mask = [[order >= len(family) for order in range(most)] for family in families]
        buffers = {
            "gate_paths": sigmoid,
            "logit_paths": logit,
            "child_paths": child,
            "siblings": torch.tensor(padded, dtype=torch.int64).flatten(),
            "sibling_mask": torch.tensor(mask, dtype=torch.bool).reshape(len(families), most),
            "sibling_places": torch.tensor(list(places.values()), dtype=torch.int64),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        depths = joint_depths(parents)
        kept = (gates.get(j, children[j][0] if children[j] else -1) for j in range(joints))
        self.tree = (
            sorted(range(joints), key=lambda joint: depths[joint]),
            [int(parent) for parent in parents],
            list(kept),
            [int(joint in gates) for joint in range(joints)],
        )
        """Order with parents first, parents, gates and whether a joint's children share."""

    def forward(self, logits: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch J"]:
        """Weights that sum to one."""
        if runs_native(logits):
            weights: Tensor = _NativeSoftmax.apply(logits.reshape(-1, self.logits), self.tree)
            return weights.unflatten(0, logits.shape[:-1])
        log_weights = nn.functional.logsigmoid(logits) @ self.gate_paths.to(logits)
        log_weights = log_weights + logits @ self.logit_paths.to(logits)
        if len(self.siblings):
            families = logits.index_select(-1, self.siblings).unflatten(-1, self.sibling_mask.shape)
            shares = families.masked_fill(self.sibling_mask, -torch.inf).log_softmax(-1).flatten(-2)
            shares = shares.index_select(-1, self.sibling_places)
            log_weights = log_weights + shares @ self.child_paths.to(logits)
        return log_weights.exp()


class _NativeSoftmax(torch.autograd.Function):
    """`HierarchicalSoftmax` in the compiled module."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, tree: tuple[list[int], ...]) -> Tensor:
        given = logits.detach().contiguous()
        weights = torch.empty(len(given), len(tree[0]))
        native.tree_softmax(given, tree, None, weights, torch.get_num_threads())
        ctx.tree = tree
        ctx.save_for_backward(given)
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (given,) = ctx.saved_tensors
        gradient = torch.empty_like(given)
        above = upstream[0].contiguous()
        native.tree_softmax(given, ctx.tree, above, gradient, torch.get_num_threads())
        return gradient, None


class SkinningNetwork(nn.Module):
    """Normalised canonical position to skinning weights (3DGS-Avatar).

    Defaults: 4 hidden layers of 128, no position encoding, no temperature.
    """

    def __init__(
        self,
        parents: Sequence[int],
        width: int = 128,
        depth: int = 4,
    ) -> None:
        super().__init__()
        self.softmax = HierarchicalSoftmax([int(parent) for parent in parents])
        self.mlp = PointMLP(3, 0, 0, width, depth, self.softmax.logits)

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch J"]:
        """Weights at positions in [-1, 1]; each sums to one."""
        logits = self.mlp(positions.reshape(-1, 3))[0]
        return self.softmax(logits).unflatten(0, positions.shape[:-1])


class SkinningTurns:
    """Looks a part of the rows up in the network each step and keeps the others' last weights.

    With ``turns`` k every k-th row is looked up, a different part each step. A step moves a
    Gaussian by a small part of what the weights notice, so that weights k steps old are the same
    in all but the last digits, and the network costs 1/k. The gradient of the rows looked up counts
    k-fold, which makes its mean over the turns that of all rows. With k = 1 nothing is kept.
    """

    def __init__(self, turns: int) -> None:
        """Nothing is kept before the first step."""
        self.turns = turns
        self.turn = 0
        self.kept = torch.zeros(0, 0)

    def weights(self, network: Network, positions: Float[Tensor, "N C"]) -> Float[Tensor, "N J"]:
        """Weights at ``positions``, or at what the network takes for them.

        All are looked up after rows were changed.
        """
        if self.turns == 1:
            return network(positions)
        if len(self.kept) != len(positions):
            self.turn, weights = 0, network(positions)
        else:
            looked_up = network(positions[self.turn :: self.turns])
            looked_up = self.turns * looked_up - (self.turns - 1) * looked_up.detach()
            kept = self.kept.to(positions.device)  # after a resume it is on the CPU
            weights = torch.slice_scatter(kept, looked_up, 0, self.turn, None, self.turns)
            self.turn = (self.turn + 1) % self.turns
        self.kept = weights.detach()
        return weights

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now: look all up again."""
        self.kept = self.kept[:0]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resume needs."""
        return {"kept": self.kept, "turn": torch.tensor(self.turn)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.kept, self.turn = state["kept"], int(state["turn"])
