"""What goes into rendering and what comes out."""

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float, Int
from torch import Tensor


class PinholeCamera(Protocol):
    """What rendering reads of a camera (`evsplat.capture.Camera` has it)."""

    @property
    def width(self) -> int:
        """Image width, pixels."""

    @property
    def height(self) -> int:
        """Image height, pixels."""

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Focal lengths and principal point in pixels; pixel centres at +0.5, no skew."""

    @property
    def world_to_camera(self) -> Float[Tensor, "4 4"]:
        """Rigid transform, OpenCV axes; may require a gradient."""


@dataclass(frozen=True)
class Splats:
    """Gaussians drawn at T times. A leading T of 1, or none, serves all times."""

    means: Float[Tensor, "T N 3"]
    """Centres in the world, metres."""
    quats: Float[Tensor, "*T N 4"]
    """Rotations wxyz, of any length but zero."""
    scales: Float[Tensor, "*T N 3"]
    """Standard deviations along the rotated axes, metres."""
    opacities: Float[Tensor, "*T N"]
    """In [0, 1]."""
    channels: Float[Tensor, "T N C"]
    """What is composited, any number of channels."""
    linear: Float[Tensor, "T N 3 3"] | None = None
    """L in covariance = (L R S)(L R S)^T: a skinning matrix with its shear. None: identity."""


@dataclass(frozen=True)
class RenderOutput:
    """Images of T times."""

    image: Float[Tensor, "T H W C"]
    """Composited channels over the background."""
    alpha: Float[Tensor, "T H W"]
    """Coverage in [0, 1)."""
    radii: Int[Tensor, "T N"]
    """Radius on the screen in pixels, rounded up; 0 = not drawn."""
