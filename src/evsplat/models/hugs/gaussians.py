"""Gaussians of HUGS: the person's, read from a triplane at their centres, and the scene's own."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.rotations import matrix_to_quaternion, six_to_matrix
from evsplat.gaussians import OneClassRows, Shape
from evsplat.models.hugs.triplane import (
    AppearanceDecoder,
    GeometryDecoder,
    SkinningDecoder,
    Triplane,
)
from evsplat.models.networks.skinning_network import SkinningTurns
from evsplat.models.networks.spherical_harmonics import SH_CONSTANT, sh_basis

START_MULTIPLIER = 0.5
"""Factor of every Gaussian's standard deviations at the start."""


@dataclass(frozen=True)
class Decoded:
    """The person's ``N`` Gaussians in canonical space."""

    offsets: Float[Tensor, "N 3"]
    """From the learned centre, metres."""
    six: Float[Tensor, "N 6"]
    """Rotations as six numbers, see `six_to_matrix`."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations before the multiplier, metres."""
    colours: Float[Tensor, "N 3"]
    """Coefficients of the constant spherical harmonic."""
    opacities: Float[Tensor, " N"]
    weights: Float[Tensor, "N J"]
    """Skinning weights; rows sum to one."""

    @property
    def rgb(self) -> Float[Tensor, "N 3"]:
        """SRGB, not below 0."""
        return (0.5 + SH_CONSTANT * self.colours).clamp_min(0)

    def quaternions(self) -> Float[Tensor, "N 4"]:
        """Unit quaternions (w, x, y, z) of the rotations."""
        return matrix_to_quaternion(six_to_matrix(self.six))


class TriplaneHuman(OneClassRows):
    """Canonical centres, their size multipliers, the triplane and its decoders.

    ``scales_log`` is the logarithm of the multiplier, (N, 1): it is not learned but falls where
    densification splits. A new Gaussian has its looks from where it is.
    """

    def __init__(
        self,
        means: Float[Tensor, "N 3"],
        joints: int,
        *,
        channels: int,
        resolution: int,
        center: Float[Tensor, "3"],
        half_side: float,
        skinning_turns: int = 1,
    ) -> None:
        """``means`` are the start, canonical metres; of the rest most is the triplane's."""
        multipliers = torch.full((len(means), 1), START_MULTIPLIER)
        super().__init__({"means": means, "scales_log": multipliers.log()}, "human")
        self.triplane = Triplane(channels, resolution, center, half_side)
        features = 3 * channels
        self.appearance = AppearanceDecoder(features)
        self.geometry = GeometryDecoder(features)
        self.skinning = SkinningDecoder(features, joints)
        self.skinning_turns = SkinningTurns(skinning_turns)

    def look_up(self, positions: Float[Tensor, "M 3"]) -> Decoded:
        """Gaussians decoded at any canonical places."""
        features = self.triplane(positions)
        return self._decode(features, self.skinning(features))

    def for_training(self) -> Decoded:
        """The person's Gaussians, a part of them with skinning weights a few steps old.

        See `SkinningTurns`; of all networks that of the skinning costs most and learns slowest.
        """
        features = self.triplane(self.means)
        return self._decode(features, self.skinning_turns.weights(self.skinning, features))

    def _decode(self, features: Tensor, weights: Tensor) -> Decoded:
        offsets, six, scales = self.geometry(features)
        colours, opacities = self.appearance(features)
        return Decoded(offsets, six, scales, colours, opacities, weights)

    def multipliers(self) -> Float[Tensor, "N 1"]:
        """Factor of each Gaussian's standard deviations."""
        return self.scales_log.detach().exp()

    @torch.no_grad()
    def shape(self) -> Shape:
        """Decoded where the Gaussians are now."""
        decoded = self.look_up(self.means)
        scales = (decoded.scales * self.multipliers()).abs()
        return Shape(scales, decoded.quaternions(), decoded.opacities)


class SphericalScene(OneClassRows):
    """Static Gaussians whose colour depends on the view by spherical harmonics.

    Attributes beside ``means``: ``scales_log`` (N, 3), ``quaternions`` (N, 4), ``opacity_logits``
    (N,), ``constant`` (N, 3) and ``directional`` (N, K, 3), the coefficients of the constant and of
    the K other harmonics.
    """

    def __init__(
        self, start: dict[str, Tensor], colours: Float[Tensor, "N 3"], degree: int
    ) -> None:
        """``start`` as `gaussians_at` makes it, ``colours`` in sRGB, ``degree`` 0 to 3."""
        kept = ("means", "scales_log", "quaternions", "opacity_logits")
        values = {name: start[name] for name in kept}
        values["constant"] = (colours.float() - 0.5) / SH_CONSTANT
        values["directional"] = torch.zeros(len(colours), (degree + 1) ** 2 - 1, 3)
        super().__init__(values, "scene")

    quaternions: nn.Parameter
    opacity_logits: nn.Parameter
    constant: nn.Parameter
    directional: nn.Parameter

    def rgb(self, camera_center: Float[Tensor, "3"], degree: int) -> Float[Tensor, "N 3"]:
        """SRGB, not below 0, seen from a place; harmonics above ``degree`` are left out."""
        colour = 0.5 + SH_CONSTANT * self.constant
        count = min((degree + 1) ** 2 - 1, self.directional.shape[1])
        if count:
            directions = nn.functional.normalize(self.means - camera_center, dim=-1)
            basis = sh_basis(directions)[:, :count]
            colour = colour + (basis[..., None] * self.directional[:, :count]).sum(1)
        return colour.clamp_min(0)

    def opacities(self) -> Float[Tensor, " N"]:
        """Opacities in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @torch.no_grad()
    def shape(self) -> Shape:
        """Read from the attributes."""
        return Shape(self.scales_log.exp(), self.quaternions.detach(), self.opacities())
