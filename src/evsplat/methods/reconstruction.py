"""Contract of a trained method: an object that draws any instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.camera import Camera
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.options.declare import Parts
from evsplat.render import Splats


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


@runtime_checkable
class Posable(Protocol):
    """A reconstruction whose person can be made to move as it was never seen to."""

    @property
    def track(self) -> BodyTrack:
        """The recorded motion and its body."""
        ...

    def following(self, track: BodyTrack) -> Reconstruction:
        """The same person and scene with the motion ``track`` (same body, own times) instead."""
        ...


@runtime_checkable
class WithDepth(Protocol):
    """A reconstruction that knows how far away what it draws is."""

    def depth(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> Float[Tensor, "T H W"]:
        """Mean of z in the camera over what a pixel shows, metres; 0 where it shows nothing."""
        ...


@runtime_checkable
class SplatReconstruction(Protocol):
    """A reconstruction that can hand its Gaussians over, for files and viewers of others."""

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel in its pictures, px^2; viewers of others take 0.3."""
        ...

    def splats(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> list[Splats]:
        """Gaussians that `Reconstruction.render` draws, world metres; the person first.

        Channels are R, G, B (sRGB) and the semantic attribute (1 = person). Colours that depend on
        the direction are those seen from ``camera``.
        """
        ...


@runtime_checkable
class Bakeable(SplatReconstruction, Posable, Protocol):
    """A reconstruction whose person can be had as Gaussians that follow a skeleton by weights."""

    def at_rest(self, views: Sequence[tuple[int, Camera]]) -> SkinnedGaussians:
        """The person's mean over ``views`` (times in us and their cameras), in canonical space."""
        ...

    def pose(
        self, times_us: Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T J 4 4"]]:
        """The recorded motion with what the method corrected of it.

        Rotations of joints against their parents, and bone transforms canonical to world.
        """
        ...
