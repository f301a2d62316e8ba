"""Decoders of the triplane's features: appearance, geometry and skinning (reference 2.1)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

TEMPERATURE = 0.1
"""Of the softmax over joints."""


def _trunk(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU())


class AppearanceDecoder(nn.Module):
    """Colour and opacity.

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
    """Offset, rotation and size."""

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
    """Skinning weights over the joints of any body."""

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
