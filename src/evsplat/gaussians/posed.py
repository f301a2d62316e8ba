"""The Gaussian set at given times: everything in world space, ready to be drawn."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.render import Splats

Parts = Literal["all", "human", "scene"]


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

    @property
    def times(self) -> int:
        """Number of times T."""
        return len(self.human.means)

    def splats(self, parts: Parts = "all") -> Splats:
        """What the rasteriser draws: channels are RGB and the semantic attribute, person first."""
        person, scene, times = self.human, self.scene, self.times
        human_channels = torch.cat(
            [person.rgb, self.human_semantics[None, :, None].expand(times, -1, 1)], dim=-1
        )
        if parts == "human":
            return Splats(
                person.means,
                person.quaternions,
                person.scales,
                self.human_opacities,
                human_channels,
                person.transforms[..., :3, :3],
            )
        scene_channels = torch.cat([scene.rgb, self.scene_semantics[:, None]], dim=-1)
        if parts == "scene":
            return Splats(
                scene.means[None],
                scene.quaternions,
                scene.scales,
                self.scene_opacities,
                scene_channels[None],
            )

        def join(human: Tensor, static: Tensor) -> Tensor:
            return torch.cat([human, static.expand(times, *static.shape)], dim=1)

        identity = torch.eye(3, dtype=scene.means.dtype, device=scene.means.device)
        return Splats(
            join(person.means, scene.means),
            join(person.quaternions, scene.quaternions),
            join(person.scales, scene.scales),
            torch.cat([self.human_opacities, self.scene_opacities]),
            join(human_channels, scene_channels),
            join(person.transforms[..., :3, :3], identity.expand(len(scene.means), 3, 3)),
        )
