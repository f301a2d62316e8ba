"""The Gaussian set at given times: everything in world space, ready to be drawn."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.render import LOW_PASS, Splats


@dataclass(frozen=True)
class PosedHuman:
    """The person's ``H`` Gaussians at T times, in world space."""

    means: Float[Tensor, "T H 3"]
    quaternions: Float[Tensor, "T H 4"]
    """Rotation in canonical space; ``transforms`` carries it to the world."""
    scales: Float[Tensor, "T H 3"]
    rgb: Float[Tensor, "T H 3"]
    transforms: Float[Tensor, "T H 4 4"]
    """Blended bone transforms, canonical to world; not rigid (blending shears)."""


@dataclass(frozen=True)
class StaticScene:
    """The scene's ``S`` Gaussians, the same at all times."""

    means: Float[Tensor, "S 3"]
    quaternions: Float[Tensor, "S 4"]
    scales: Float[Tensor, "S 3"]
    rgb: Float[Tensor, "S 3"]


@dataclass(frozen=True)
class PosedGaussians:
    """Both classes with what they share; opacities and semantics are person first."""

    human: PosedHuman
    scene: StaticScene
    human_opacities: Float[Tensor, " H"]
    scene_opacities: Float[Tensor, " S"]
    human_semantics: Float[Tensor, " H"]
    """Soft attribute m (or the hard label, for evaluation), drawn as a fourth channel."""
    scene_semantics: Float[Tensor, " S"]
    casters: Float[Tensor, "T P 3"] | None = None
    """Points of the body that hide the light; without them there are no shadows."""
    low_pass: float = LOW_PASS
    """Low-pass of the projection, px^2; see `evsplat.render.render`."""

    @property
    def times(self) -> int:
        """Number of times T."""
        return len(self.human.means)

    def moving(self) -> Splats:
        """The person for the rasteriser; channels are RGB and the semantic attribute."""
        human = self.human
        channel = self.human_semantics[None, :, None].expand(self.times, -1, 1)
        return Splats(
            human.means,
            human.quaternions,
            human.scales,
            self.human_opacities,
            torch.cat([human.rgb, channel], dim=-1),
            human.transforms[..., :3, :3],
        )

    def static(self) -> Splats:
        """The scene for the rasteriser, one for all times."""
        scene = self.scene
        return Splats(
            scene.means[None],
            scene.quaternions,
            scene.scales,
            self.scene_opacities,
            torch.cat([scene.rgb, self.scene_semantics[:, None]], dim=-1)[None],
        )
