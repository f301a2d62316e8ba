"""A person at rest, ready to be moved by a skeleton alone."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import Body, skin
from evsplat.render import Splats


@dataclass(frozen=True, eq=False)
class SkinnedGaussians:
    """H Gaussians in canonical space with weights of the body's J bones, and nothing learned else.

    What a pose does to a person beyond skinning (cloth, muscles, light) is not in it.
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
    """sRGB."""
    weights: Float[Tensor, "H J"]
    """Of bones, each row sums to 1."""

    def posed(self, bones: Float[Tensor, "T J 4 4"]) -> Splats:
        """Splats for bone transforms canonical to world; channels R, G, B and 1 (a person)."""
        means, transforms = skin(self.means, self.weights, bones)
        ones = self.rgb.new_ones(len(self.rgb), 1)
        channels = torch.cat([self.rgb, ones], -1).expand(len(bones), -1, -1)
        return Splats(
            means,
            self.quaternions,
            self.scales,
            self.opacities,
            channels,
            transforms[..., :3, :3],
        )
