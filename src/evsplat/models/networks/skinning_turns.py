"""Skinning weights of a training step for the cost of a part of the rows."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Network = Callable[[Float[Tensor, "M C"]], Float[Tensor, "M J"]]


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
