"""The nearest point of the body's surface to each of the person's Gaussians."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.body.surface import SurfaceSamples
from evsplat.neighbours import nearest


class NearestSurface:
    """Normals and bones of Gaussians by the nearest point of the canonical body's surface.

    Looked up again only after rows have changed: between two densifications a Gaussian moves by
    less than what turns the surface or changes the bones it hangs on.
    """

    def __init__(self, surface: SurfaceSamples) -> None:
        """``surface``: samples of the canonical body."""
        self.surface = surface
        self.index = torch.zeros(0, dtype=torch.long)
        self._found: tuple[Tensor, Tensor, Tensor] | None = None

    def normals(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit normals at the canonical centres of all Gaussians."""
        return self._at_all(means)[0]

    def weights(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Skinning weights at the canonical centres of all Gaussians."""
        return self._at_all(means)[1]

    def _at_all(self, means: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor]:
        index = self._of(means)
        if self._found is None or self._found[2] is not index:
            surface = self._on(means.device)
            self._found = surface.normals[index], surface.weights[index], index
        return self._found[:2]

    def _of(self, means: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        if len(self.index) != len(means):
            points = self._on(means.device).points
            self.index = nearest(points, 1, means.detach())[1][:, 0]
        self.index = self.index.to(means.device)  # after a resume it is on the CPU
        return self.index

    def _on(self, device: torch.device) -> SurfaceSamples:
        if self.surface.points.device != device:
            self.surface = self.surface.to(device)
        return self.surface

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        self.index = self.index[:0]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resume needs."""
        return {"index": self.index}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.index = state["index"]
