"""How bright the person's surface is, by where it stands and how it is turned."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body.surface import SurfaceSamples
from evsplat.deform.spherical_harmonics import sh_basis
from evsplat.neighbours import nearest

_NORMAL_DIM = 9
_DARKEST, _BRIGHTEST = 0.2, 3.0


class Shading(nn.Module):
    """A factor on the person's canonical colours, shared by all Gaussians and times.

    It is a polynomial of degree 2 in the world normal (nine spherical harmonics, the irradiance of
    distant light; Ramamoorthi and Hanrahan 2001) whose coefficients vary linearly with the place,
    per colour: 108 numbers, no pose among its inputs, so that what it learns holds for poses that
    no frame shows. Starts at 1 everywhere.
    """

    center: Tensor
    radius_m: Tensor

    def __init__(self, center: Float[Tensor, "3"], radius_m: float) -> None:
        """Where the person goes: places are relative to ``center``, in units of ``radius_m``."""
        super().__init__()
        self.register_buffer("center", center.clone())
        self.register_buffer("radius_m", torch.tensor(float(radius_m)))
        self.coefficients = nn.Parameter(torch.zeros(4, _NORMAL_DIM, 3))

    def forward(
        self, normals: Float[Tensor, "T N 3"], places: Float[Tensor, "T N 3"]
    ) -> Float[Tensor, "T N 3"]:
        """Factors in 0.2..3 at unit world normals and world places (metres)."""
        turned = torch.cat([torch.ones_like(normals[..., :1]), sh_basis(normals, degree=2)], -1)
        moved = ((places - self.center) / self.radius_m).clamp(-2, 2)
        # First all coefficients at the normals, then their sum at the places: nothing of size
        # T x N x 36 is ever there.
        at_normals = (turned @ self.coefficients.movedim(1, 0).flatten(1)).unflatten(-1, (4, 3))
        bent = at_normals[..., 0, :] + (moved[..., None] * at_normals[..., 1:, :]).sum(-2)
        return (1 + bent).clamp(_DARKEST, _BRIGHTEST)


class SurfaceNormals:
    """Canonical normals of Gaussians: those of the nearest point of the body's surface.

    Looked up again only after rows have changed: between two densifications a Gaussian moves by
    less than what turns the surface.
    """

    def __init__(self, surface: SurfaceSamples) -> None:
        """``surface``: samples of the canonical body."""
        self.surface = surface
        self.normals = torch.zeros(0, 3)

    def of(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit normals at canonical centres."""
        if len(self.normals) != len(means):
            self.surface = self.surface.to(means.device)
            _, index = nearest(self.surface.points, 1, means.detach())
            self.normals = self.surface.normals[index[:, 0]]
        self.normals = self.normals.to(means.device)
        return self.normals

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        self.normals = self.normals[:0]

    def state(self) -> dict[str, Tensor]:
        """What a resume needs."""
        return {"normals": self.normals}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.normals = state["normals"]
