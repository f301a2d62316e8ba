"""The scene: 3D Gaussian splatting's own set, with spherical harmonics."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.gaussians import OneClassRows, Shape
from evsplat.models.hugs.human import SH_CONSTANT
from evsplat.models.networks.spherical_harmonics import sh_basis


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
