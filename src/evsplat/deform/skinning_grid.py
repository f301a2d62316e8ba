"""Skinning weights baked on the nodes of a voxel grid: a lookup without the network."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

Network = Callable[[Float[Tensor, "M 3"]], Float[Tensor, "M J"]]


class SkinningGrid:
    """Weights at the nodes around a person's Gaussians, trilinear between them.

    The grid spans the body's box, [-1, 1] along each axis, with ``cells`` along each side; GART and
    other fast avatars read skinning weights so. Weights stay a mean of the network's own: none is
    negative and each row sums to one. Positions outside the baked cells ask the network.
    """

    def __init__(self, cells: int) -> None:
        """Empty; see `bake`."""
        self.cells = cells
        self.rows = torch.full(((cells + 1) ** 3,), -1, dtype=torch.int32)
        """Of each node: its row of the table; -1 where nothing is baked."""
        self.table = torch.zeros(0, 0)
        """Weights of the nodes that are baked, in the order of these."""
        axes = torch.arange(2)
        self._corners = torch.cartesian_prod(axes, axes, axes)
        self._baked: tuple[tuple[int, int], ...] = ()

    def fresh_weights(
        self, network: nn.Module, positions: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch J"]:
        """Weights at positions, baked anew whenever the network has changed since."""
        state = tuple((value.data_ptr(), value._version) for value in network.parameters())
        flat = positions.reshape(-1, 3)
        if state != self._baked:
            self.bake(network, flat)
            self._baked = state
        return self.weights(network, flat).unflatten(0, positions.shape[:-1])

    @torch.no_grad()
    def bake(self, network: Network, positions: Float[Tensor, "N 3"]) -> None:
        """Ask the network at all nodes of the cells around ``positions`` and of their neighbours.

        A ring of cells more than now needed: positions move before the next time.
        """
        side = self.cells + 1
        mask = positions.new_zeros(side**3)
        mask[self._around(positions.detach())[0].flatten()] = 1
        grown = nn.functional.max_pool3d(mask.view(1, 1, side, side, side), 3, 1, 1)
        nodes = grown.flatten().nonzero()[:, 0]
        places = torch.stack([nodes // side**2, nodes // side % side, nodes % side], -1)
        self.table = network(places.to(positions) * (2 / self.cells) - 1)
        self.rows = torch.full_like(self.rows, -1, device=positions.device)
        self.rows[nodes] = torch.arange(len(nodes), dtype=torch.int32, device=positions.device)

    def weights(self, network: Network, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights at positions, with gradients with respect to these; the table has none."""
        nodes, shares = self._around(positions)
        rows = self.rows[nodes]
        outside = (rows < 0).any(-1) | (positions.detach().abs() > 1).any(-1)
        weights: Tensor = nn.functional.embedding_bag(
            rows.clamp(min=0), self.table, per_sample_weights=shares, mode="sum"
        )
        if bool(outside.any()):
            apart = outside.nonzero()[:, 0]
            weights = weights.index_copy(0, apart, network(positions[apart]))
        return weights

    def _around(self, positions: Tensor) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
        """The nodes of each position's cell, and their trilinear shares."""
        corners, side = self._corners.to(positions.device), self.cells + 1
        places = (positions + 1) * (self.cells / 2)
        low = places.detach().floor().clamp(0, self.cells - 1)
        strides = torch.tensor([side**2, side, 1], device=positions.device)
        nodes = ((low.long()[:, None] + corners) * strides).sum(-1)
        inside = (places - low)[:, None]
        return nodes, torch.where(corners.bool(), inside, 1 - inside).prod(-1)
