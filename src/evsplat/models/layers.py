"""Person and scene at given times, in world space: what a model hands to the rasteriser."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.render import LOW_PASS, Splats

SHADOW_STEP_PX = 2
"""Shadows are soft: they are looked up at every second pixel and interpolated."""

SceneShadow = Callable[[Float[Tensor, "H W 3"]], Float[Tensor, "T H W"]]
"""Factors in 0..1 on the scene's colours at world places, one picture per time."""


@dataclass(frozen=True, eq=False)
class Layers:
    """The person's ``H`` Gaussians at T times and the scene's ``S``, which are the same at all.

    Channels of both are R, G, B (sRGB) and the semantic attribute: the soft m, or the hard label
    for evaluation.
    """

    human: Splats
    """Rotations are those of canonical space; ``linear`` carries them to the world."""
    scene: Splats
    """With a leading axis of one time."""
    transforms: Float[Tensor, "T H 4 4"]
    """The person's blended bone transforms, canonical to world; not rigid (blending shears)."""
    shadow: SceneShadow | None = None
    """The person's shadow on the scene."""
    low_pass: float = LOW_PASS
    """Variance of the filter of a pixel, px^2; see `evsplat.render.render`."""
    shaded: Float[Tensor, "T h w"] | None = None
    """The shadow at every `SHADOW_STEP_PX`-th pixel of the pictures that will be drawn, one per
    time, where it was found beside that on the person."""

    @property
    def times(self) -> int:
        """Number of times T."""
        return len(self.human.means)

    def of_time(self, index: int) -> "Layers":
        """The same at one of the times alone."""
        only, shadow = slice(index, index + 1), self.shadow
        return replace(
            self,
            human=self.human.of_time(index),
            transforms=self.transforms[only],
            shadow=None if shadow is None else lambda places: shadow(places)[only],
            shaded=None if self.shaded is None else self.shaded[only],
        )


def human_splats(
    means: Float[Tensor, "T H 3"],
    quaternions: Float[Tensor, "#T H 4"],
    scales: Float[Tensor, "#T H 3"],
    opacities: Float[Tensor, " H"],
    rgb: Float[Tensor, "#T H 3"],
    semantics: Float[Tensor, " H"],
    linear: Float[Tensor, "T H 3 3"],
) -> Splats:
    """The person's layer; what is the same at all times may have an axis of one time.

    Rotations and scales keep it: they are drawn, and their gradients summed, without copies.
    ``linear``: the blended matrices' 3x3 part, see `skin_with_linear`.
    """
    times = (len(means), -1, -1)
    channels = torch.cat([rgb.expand(times), semantics[None, :, None].expand(times)], -1)
    return Splats(means, quaternions, scales, opacities, channels, linear)


def scene_splats(
    means: Float[Tensor, "S 3"],
    quaternions: Float[Tensor, "S 4"],
    scales: Float[Tensor, "S 3"],
    opacities: Float[Tensor, " S"],
    rgb: Float[Tensor, "S 3"],
    semantics: Float[Tensor, " S"],
) -> Splats:
    """The scene's layer."""
    channels = torch.cat([rgb, semantics[:, None]], dim=-1)[None]
    return Splats(means[None], quaternions, scales, opacities, channels)
