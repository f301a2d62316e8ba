"""A person at rest, ready to be moved by a skeleton alone."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import Body, skin
from evsplat.deform.shading import SurfaceLight
from evsplat.render import Splats


@dataclass(frozen=True, eq=False)
class SkinnedGaussians:
    """H Gaussians in canonical space with weights of the body's J bones, and the light on them.

    What a pose does to a person beyond that (cloth, muscles, own shadow) is not in it.
    """

    body: Body
    means: Float[Tensor, "H 3"]
    """Centres, canonical metres."""
    quaternions: Float[Tensor, "H 4"]
    """Unit, (w, x, y, z)."""
    scales: Float[Tensor, "H 3"]
    """Standard deviations, metres."""
    opacities: Float[Tensor, " H"]
    rgb: Float[Tensor, "H 3"]
    """sRGB; without the light, where that is known."""
    weights: Float[Tensor, "H J"]
    """Of bones, each row sums to 1."""
    light: SurfaceLight | None
    """None: it is in the colours."""

    def at_rest(self) -> Splats:
        """Splats in the canonical pose, without light; channels as those of `posed`."""
        identity = torch.eye(4).expand(1, self.weights.shape[1], 4, 4)
        return replace(self, light=None).posed(identity)

    @torch.no_grad()
    def posed(self, bones: Float[Tensor, "T J 4 4"]) -> Splats:
        """Splats for bone transforms canonical to world; channels R, G, B and 1 (a person)."""
        means, transforms = skin(self.means, self.weights, bones)
        rgb = self.rgb.expand(len(bones), -1, -1)
        if self.light is not None:
            rgb = rgb * self.light.factors(transforms, means)
        channels = torch.cat([rgb, torch.ones_like(rgb[..., :1])], -1)
        return Splats(
            means,
            self.quaternions,
            self.scales,
            self.opacities,
            channels,
            transforms[..., :3, :3],
        )
