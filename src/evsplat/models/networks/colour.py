"""Colour networks of human and scene Gaussians."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.camera import Camera
from evsplat.compiled import native, runs_native
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.networks.spherical_harmonics import sh_basis
from evsplat.render import rows_in_view

_DIRECTION_DIM = 15


class HumanColour(nn.Module):
    """Colour of human Gaussians (3DGS-Avatar): 79 inputs, two hidden layers of 64, sigmoid."""

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
        return self.mlp(features, latent, beside_basis(directions, nonrigid)).sigmoid()


class SceneColour(nn.Module):
    """Colour of scene Gaussians (paper eq. 7, A10): feature and view direction, no latent.

    For a static camera the direction is only a hash of the position, which says nothing in a novel
    view: training hides it now and then, by directions of zero, whose basis is zero.
    """

    def __init__(self, feature_dim: int = 32, width: int = 64) -> None:
        super().__init__()
        self.mlp = PointMLP(feature_dim + _DIRECTION_DIM, 0, 0, width, depth=2, out=3)

    def forward(
        self, features: Float[Tensor, "N 32"], directions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """SRGB in [0, 1]; ``directions`` are unit vectors from the camera in the world, or zero."""
        return self.mlp(beside_basis(directions, features, values_first=True))[0].sigmoid()


def scene_rgb(
    network: nn.Module,
    features: Float[Tensor, "S 32"],
    means: Float[Tensor, "S 3"],
    scales: Float[Tensor, "S 3"],
    camera_center: Float[Tensor, "3"],
    *,
    shown: Sequence[Camera],
    hide_direction: bool,
) -> Float[Tensor, "S 3"]:
    """Colours of a scene by a `SceneColour`; places in metres, ``scales`` standard deviations.

    ``shown``: only these cameras' pictures are asked for, if any are given; rows that reach into
    none of them may be black. ``hide_direction``: the network sees no view direction in this step.
    """
    count = len(means)
    rows = rows_in_view(means, scales, *shown) if shown else None
    if rows is not None:
        features, means = features.index_select(0, rows), means.detach().index_select(0, rows)
    directions = view_directions(means[None], camera_center)[0]
    if hide_direction:
        directions = torch.zeros_like(directions)
    rgb: Tensor = network(features, directions)
    return rgb if rows is None else rgb.new_zeros(count, 3).index_copy(0, rows, rgb)


def beside_basis(
    directions: Float[Tensor, "*batch 3"],
    values: Float[Tensor, "*batch V"],
    *,
    values_first: bool = False,
) -> Float[Tensor, "*batch V+15"]:
    """The basis of unit vectors up to degree 3, without its constant, beside other values."""
    if runs_native(directions) and runs_native(values) and not directions.requires_grad:
        joined: Tensor = _NativeBesideBasis.apply(directions, values, values_first)
        return joined
    basis = sh_basis(directions)
    return torch.cat((values, basis) if values_first else (basis, values), -1)


class _NativeBesideBasis(torch.autograd.Function):
    """`beside_basis` for directions without a gradient."""

    @staticmethod
    def forward(ctx: Any, directions: Tensor, values: Tensor, values_first: bool) -> Tensor:
        count = values.shape[-1]
        first = 0 if values_first else _DIRECTION_DIM
        ctx.columns = slice(first, first + count)
        joined = values.new_empty(*values.shape[:-1], count + _DIRECTION_DIM)
        given = directions.contiguous(), values.detach().contiguous()
        native.sh_rows(*given, joined, values_first, torch.get_num_threads())
        return joined

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[None, Tensor, None]:
        return None, upstream[0][..., ctx.columns], None


def view_directions(
    positions: Float[Tensor, "T N 3"],
    center: Float[Tensor, "3"],
    transforms: Float[Tensor, "T N 4 4"] | None = None,
    turn: Float[Tensor, "3 3"] | None = None,
) -> Float[Tensor, "T N 3"]:
    """Unit vectors from ``center`` to positions, without a gradient.

    Each is turned back by the transposed 3x3 part of its transform, then all by ``turn``.
    """
    positions = positions.detach()
    transforms = None if transforms is None else transforms.detach()
    if runs_native(positions):
        directions = torch.empty(positions.shape)
        native.view_directions(
            positions.contiguous(),
            None if transforms is None else transforms.contiguous(),
            center.tolist(),
            (torch.eye(3) if turn is None else turn).flatten().tolist(),
            directions,
            torch.get_num_threads(),
        )
        return directions
    view = positions - center
    if transforms is not None:
        view = (view[..., None, :] @ transforms[..., :3, :3])[..., 0, :]
    if turn is not None:
        view = view @ turn.T
    return nn.functional.normalize(view, dim=-1)


def view_jitter(
    generator: torch.Generator | None = None, *, symmetric: bool = False
) -> Float[Tensor, "3 3"]:
    """One random rotation for all canonical view directions of a training step (3DGS-Avatar).

    Three Euler angles about x, y, z: two normal with 45 degrees, clipped at 90; the third uniform
    in 0..45 as in the released code, or like the others if ``symmetric`` (what was surely meant).
    """
    quarter = math.pi / 4
    angles = (torch.randn(3, generator=generator) * quarter).clamp(-2 * quarter, 2 * quarter)
    if not symmetric:
        angles[2] = torch.rand((), generator=generator) * quarter
    x, y, z = axis_angle_to_matrix(torch.diag(angles))
    return z @ y @ x
