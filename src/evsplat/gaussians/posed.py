"""The Gaussian set at given times: everything in world space, ready to be drawn."""

from dataclasses import dataclass, fields

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
class SecondCopies:
    """Rows whose class is open, once more in the class that is not theirs."""

    human: PosedHuman
    """K rows of the scene, posed."""
    scene: StaticScene
    """L rows of the person, standing still."""
    human_opacities: Float[Tensor, " K"]
    scene_opacities: Float[Tensor, " L"]


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
    copies: SecondCopies | None = None
    """Drawn besides, after the rows of their layer."""
    low_pass: float = LOW_PASS
    """What the pixels of a picture integrate over, px^2; see `evsplat.render.render`."""

    @property
    def times(self) -> int:
        """Number of times T."""
        return len(self.human.means)

    def moving(self) -> Splats:
        """What the rasteriser draws of the person; channels are RGB and the semantic attribute."""
        person, opacities, semantics = self.human, self.human_opacities, self.human_semantics
        if (copies := self.copies) is not None:
            pairs = [
                (getattr(person, f.name), getattr(copies.human, f.name)) for f in fields(person)
            ]
            person = PosedHuman(*(torch.cat(pair, 1) for pair in pairs))
            opacities = torch.cat([opacities, copies.human_opacities])
            semantics = torch.cat([semantics, torch.ones_like(copies.human_opacities)])
        channel = semantics[None, :, None].expand(self.times, -1, 1)
        return Splats(
            person.means,
            person.quaternions,
            person.scales,
            opacities,
            torch.cat([person.rgb, channel], dim=-1),
            person.transforms[..., :3, :3],
        )

    def static(self) -> Splats:
        """The same of the scene, one for all times."""
        scene, opacities, semantics = self.scene, self.scene_opacities, self.scene_semantics
        if (copies := self.copies) is not None:
            pairs = [(getattr(scene, f.name), getattr(copies.scene, f.name)) for f in fields(scene)]
            scene = StaticScene(*(torch.cat(pair) for pair in pairs))
            opacities = torch.cat([opacities, copies.scene_opacities])
            semantics = torch.cat([semantics, torch.zeros_like(copies.scene_opacities)])
        return Splats(
            scene.means[None],
            scene.quaternions,
            scene.scales,
            opacities,
            torch.cat([scene.rgb, semantics[:, None]], dim=-1)[None],
        )
