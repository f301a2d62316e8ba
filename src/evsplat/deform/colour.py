"""Colour networks of human and scene Gaussians."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.deform.mlp import PointMLP
from evsplat.deform.spherical_harmonics import sh_basis

_DIRECTION_DIM = 15


class HumanColour(nn.Module):
    """Colour of human Gaussians (method.md 1.7): 79 inputs, two hidden layers of 64, sigmoid."""

    def __init__(
        self,
        feature_dim: int = 32,
        nonrigid_dim: int = 16,
        latent_dim: int = 16,
        width: int = 64,
    ) -> None:
        super().__init__()
        self.mlp = PointMLP(
            feature_dim,
            latent_dim,
            _DIRECTION_DIM + nonrigid_dim,
            width,
            depth=2,
            out=3,
        )

    def forward(
        self,
        features: Float[Tensor, "N 32"],
        directions: Float[Tensor, "T N 3"],
        nonrigid: Float[Tensor, "T N 16"],
        latent: Float[Tensor, "T 16"],
    ) -> Float[Tensor, "T N 3"]:
        """SRGB in [0, 1].

        ``directions`` are unit vectors from the camera to the Gaussian, turned back to canonical
        space; ``latent`` is the frame's.
        """
        both = torch.cat((sh_basis(directions), nonrigid), -1)
        return self.mlp(features, latent, both).sigmoid()


class SceneColour(nn.Module):
    """Colour of scene Gaussians (paper eq. 7, A10): feature and view direction, no latent.

    ``view_dependent`` False leaves the direction out. With ``direction_dropout`` p in (0, 1] the
    directional values of a Gaussian are zeroed with probability p while training: with a static
    camera the direction is only a hash of the position, which says nothing in a novel view.
    """

    def __init__(
        self,
        feature_dim: int = 32,
        view_dependent: bool = True,
        direction_dropout: float = 0.0,
        width: int = 64,
    ) -> None:
        super().__init__()
        if not 0 <= direction_dropout <= 1:
            raise ValueError(f"direction_dropout is {direction_dropout}, expected 0..1")
        self.view_dependent = view_dependent
        self.direction_dropout = direction_dropout
        inputs = feature_dim + (_DIRECTION_DIM if view_dependent else 0)
        self.mlp = PointMLP(inputs, 0, 0, width, depth=2, out=3)

    def forward(
        self, features: Float[Tensor, "N 32"], directions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """SRGB in [0, 1]; ``directions`` are unit vectors from the camera in the world."""
        inputs = features
        if self.view_dependent:
            basis = sh_basis(directions)
            if self.training and self.direction_dropout > 0:
                kept = torch.rand(len(basis), 1, device=basis.device) >= self.direction_dropout
                basis = basis * kept
            inputs = torch.cat((features, basis), -1)
        return self.mlp(inputs)[0].sigmoid()


def view_jitter(
    generator: torch.Generator | None = None, *, symmetric: bool = False
) -> Float[Tensor, "3 3"]:
    """One random rotation for all canonical view directions of a training step (method.md 1.7).

    Three Euler angles about x, y, z: two normal with 45 degrees, clipped at 90; the third uniform
    in 0..45 as in the released code, or like the others if ``symmetric`` (what was surely meant).
    """
    quarter = math.pi / 4
    angles = (torch.randn(3, generator=generator) * quarter).clamp(-2 * quarter, 2 * quarter)
    if not symmetric:
        angles[2] = torch.rand((), generator=generator) * quarter
    x, y, z = axis_angle_to_matrix(torch.diag(angles))
    return z @ y @ x
