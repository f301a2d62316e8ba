"""Contract of a trained method: an object that draws any instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.options.declare import Parts


@dataclass(frozen=True, eq=False)
class Rendering:
    """Pictures of T instants."""

    rgb: Float[Tensor, "T H W 3"]
    """sRGB in [0, 1] up to the rounding of the method; not clamped."""
    alpha: Float[Tensor, "T H W"]
    """Opacity of what was drawn, in [0, 1]."""
    human: Float[Tensor, "T H W"]
    """The person's share of the pixel after compositing, in [0, 1]; 0 where a method has none."""


class Reconstruction(Protocol):
    """A reconstructed person and scene."""

    @property
    def name(self) -> str:
        """Name of the method, as in tables."""

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """Draw the instants ``times_us`` (camera clock) as ``camera`` sees them.

        ``parts`` leaves out the scene ("human") or the person ("scene"); what is left out is black.
        """
        ...
