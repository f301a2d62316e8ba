"""Features of space on three axis-aligned planes, and their decoders (reference 2.1)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

_FIRST, _SECOND = [0, 0, 1], [1, 2, 2]
"""Axes of the planes xy, xz and yz."""
TEMPERATURE = 0.1
"""Temperature of the softmax over joints."""


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


def _trunk(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU())


class AppearanceDecoder(nn.Module):
    """Decoder of colour and opacity.

    The released decoder gives 48 spherical harmonics of which it draws the first three; the others
    take part in nothing and are left out.
    """

    def __init__(self, inputs: int, width: int = 64) -> None:
        super().__init__()
        self.trunk = _trunk(inputs, width)
        self.colour, self.opacity = nn.Linear(width, 3), nn.Linear(width, 1)

    def forward(
        self, features: Float[Tensor, "N F"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
        """Coefficients of the constant spherical harmonic, and opacities."""
        hidden = self.trunk(features)
        return self.colour(hidden), self.opacity(hidden)[:, 0].sigmoid()


class GeometryDecoder(nn.Module):
    """Decoder of offset, rotation and size."""

    def __init__(self, inputs: int, width: int = 128) -> None:
        super().__init__()
        self.trunk = _trunk(inputs, width)
        self.offset, self.rotation = nn.Linear(width, 3), nn.Linear(width, 6)
        self.scale = nn.Linear(width, 3)

    def forward(
        self, features: Float[Tensor, "N F"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 6"], Float[Tensor, "N 3"]]:
        """Offset in metres, rotation as six numbers, standard deviations before the multiplier.

        Those pass a GELU and so may be a little below zero; a Gaussian is drawn the same.
        """
        hidden = self.trunk(features)
        scales = nn.functional.gelu(self.scale(hidden))
        return self.offset(hidden), self.rotation(hidden), scales


class SkinningDecoder(nn.Module):
    """Decoder of skinning weights over the joints of any body."""

    def __init__(self, inputs: int, joints: int, width: int = 128) -> None:
        super().__init__()
        self.trunk = _trunk(inputs, width)
        self.normed = weight_norm(nn.Linear(width, width))
        self.joints = nn.Linear(width, joints)

    def forward(self, features: Float[Tensor, "N F"]) -> Float[Tensor, "N J"]:
        """Weights that sum to one."""
        hidden = nn.functional.gelu(self.normed(self.trunk(features)))
        scores = nn.functional.gelu(self.joints(hidden))
        return torch.softmax(scores / TEMPERATURE, dim=-1)
