"""Discs that show what is wrong from elsewhere become transparent, as far as the pictures bear it.

Where the body is wider than the person, discs that turn their back to the camera lie before the
background and took its colour; others float off the body, at a depth that no camera saw. Another
colour for them would be missed in the pictures; without them one sees what they imitate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.models.discs.shading import NearestSurface
from evsplat.models.layers import Layers
from evsplat.models.seen import draw_values, transposed
from evsplat.neighbours import median_around
from evsplat.probes import random_signs

WRONG, WRONG_FROM = 0.02, 0.1
"""Price of a pixel of colour that differs by more than the second from what neighbours tell, per
squared difference beyond it; a squared error of the training pictures costs 1."""
OFF, OFF_FROM_M, OFF_MOST_M = 1.0, 0.007, 0.02
"""Price of a pixel of a disc that stands off the body by more than the second farther than its
neighbours, per squared metre beyond it, of which no more than the third count."""
ROUNDS = 4
_DRAWS = 2
"""Random signs per picture that squared slopes are estimated with."""
_DAMPED = 2
"""Steps are shorter by it, since discs behind each other give way together."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A picture that shall stay, and what draws it."""

    layers: Layers
    camera: Camera
    human: Float[Tensor, "1 H 3"]
    """Colours of the person in the light, sRGB."""
    picture: Float[Tensor, "1 H W 3"]


def off_the_body(
    means: Float[Tensor, "H 3"], normals: Float[Tensor, "H 3"], surface: NearestSurface
) -> Float[Tensor, " H"]:
    """How much farther outside the body each disc stands than half of its neighbours, metres.

    Canonical ``means`` of all discs of the person; negative where it lies farther inside.
    """
    means = means.detach()
    heights = ((means - surface.surface.points[surface.at(means)]) * normals).sum(-1)
    return heights - median_around(means, heights)


def prices(
    wrong: Float[Tensor, " H"], off_m: Float[Tensor, " H"], pixels: Float[Tensor, " H"]
) -> Float[Tensor, " H"]:
    """What each disc costs for as long as it is opaque; 0 of those that may stay.

    ``wrong``: distance of its colour to what neighbours tell, sRGB; ``off_m`` as `off_the_body`;
    ``pixels`` that a disc of its size has in all pictures.
    """
    differs = (wrong - WRONG_FROM).clamp_min(0)
    stands = (off_m - OFF_FROM_M).clamp(0, OFF_MOST_M)
    return pixels * (WRONG * differs.square() + OFF * stands.square())


def areas(gaussians: GaussianSet) -> Float[Tensor, " H"]:
    """Sizes of the person's discs against their mean."""
    scales = gaussians.scales_log[gaussians.human].detach().exp().sort(-1).values
    sizes = scales[:, 1] * scales[:, 2]
    return sizes / sizes.mean()


def kept_opacity(
    sights: Sequence[Sight], price: Float[Tensor, " H"], rounds: int = ROUNDS
) -> Float[Tensor, " H"]:
    """Factors x in 0..1 on opacities that minimise the pictures' squared error + ``price`` x.

    Only discs that have a price change. Projected steps along the gradient, each by its own squared
    slopes (a picture is linear in each one's opacity), which are estimated as in `seen_by`.
    """
    kept, priced = torch.ones_like(price), price > 0
    if not bool(priced.any()):
        return kept
    generator = torch.Generator().manual_seed(0)
    for _ in range(rounds):
        pull, slopes = torch.zeros_like(price), torch.zeros_like(price)
        for sight in sights:
            leaf = kept.clone().requires_grad_()
            scene = sight.layers.scene.channels[..., :3]
            drawn = draw_values(sight.layers, sight.camera, sight.human, scene, leaf)
            missed = drawn.detach() - sight.picture
            pull += transposed(drawn, leaf, missed, again=True)
            for _ in range(_DRAWS):
                signs = random_signs(drawn, generator)
                slopes += transposed(drawn, leaf, signs, again=True).square() / _DRAWS
        least = torch.finfo(slopes.dtype).tiny
        step = (pull + price / 2) / (_DAMPED * slopes).clamp_min(least)
        kept = torch.where(priced, (kept - step).clamp(0, 1), kept)
    return kept
