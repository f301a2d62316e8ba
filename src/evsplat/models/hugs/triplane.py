"""Features of space on three axis-aligned planes (reference 2.1)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

_FIRST, _SECOND = [0, 0, 1], [1, 2, 2]
"""Axes of the planes xy, xz and yz."""


class Triplane(nn.Module):
    """Bilinear look-up in three planes over a cube, the features of the planes side by side.

    Corner texels lie on the corners of the cube. Points outside read its nearest face: the released
    code stops with an assertion there.
    """

    def __init__(
        self,
        channels: int,
        resolution: int,
        center: Float[Tensor, "3"],
        half_side: float,
    ) -> None:
        """Standard normal features, ``resolution`` squared texels on each plane."""
        super().__init__()
        self.resolution, self.half_side = resolution, half_side
        self.center: Tensor
        self.register_buffer("center", center.float())
        # A row per texel: its channels lie together, so that a look-up reads few cache lines.
        self.texels = nn.Parameter(torch.randn(3 * resolution**2, channels))

    def forward(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
        """Features of all three planes at ``positions``, metres."""
        rows, shares = self._corners(positions)
        features = nn.functional.embedding_bag(
            rows.flatten(0, 1), self.texels, per_sample_weights=shares.flatten(0, 1), mode="sum"
        )
        return features.view(len(positions), -1)

    def _corners(
        self, positions: Float[Tensor, "N 3"]
    ) -> tuple[Int[Tensor, "N 3 4"], Float[Tensor, "N 3 4"]]:
        """The four texels around each point on each plane, and their shares."""
        last = self.resolution - 1
        place = (positions - self.center) / self.half_side
        grid = (place.clamp(-1, 1) + 1) * (last / 2)
        low = grid.detach().floor().clamp(max=last - 1)
        part = grid - low
        low = low.long()
        column, row = low[:, _FIRST], low[:, _SECOND]
        planes = torch.arange(3, device=positions.device) * self.resolution**2
        corner = planes + row * self.resolution + column
        rows = torch.stack(
            [corner, corner + 1, corner + self.resolution, corner + self.resolution + 1], -1
        )
        u, v = part[:, _FIRST], part[:, _SECOND]
        shares = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], -1)
        return rows, shares
