"""The decoders start as the body: its skinning weights, its normals, Gaussians of even size."""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import SurfaceSamples
from evsplat.body.rotations import matrix_to_six, quaternion_to_matrix
from evsplat.devices import send
from evsplat.gaussians import Adam
from evsplat.gaussians.initialise import facing
from evsplat.models.hugs.gaussians import TriplaneHuman
from evsplat.neighbours import nearest

START_COLOUR, START_OPACITY = 0.5, 0.1
NEIGHBOURS = 6
TEXEL_RATE, DECODER_RATE = 5e-2, 5e-3
"""Learning rates of the fit."""
_SAME_LIMB, _SHARPNESS = 0.9, 0.02


def body_weights(
    points: Float[Tensor, "N 3"],
    vertices: Float[Tensor, "V 3"],
    weights: Float[Tensor, "V J"],
) -> Float[Tensor, "N J"]:
    """Skinning weights of the body around canonical ``points``.

    A mean over the six nearest vertices, weighted by ``exp(-distance^2)``, metres; of those only
    the ones that move as the nearest does count, ``exp(-|w - w_nearest|_1 / 0.02) > 0.9``.
    """
    distances, rows = nearest(vertices, min(NEIGHBOURS, len(vertices)), points)
    around = weights[rows]
    difference = (around - around[:, :1]).abs().sum(-1)
    alike = torch.exp(-difference / _SHARPNESS) > _SAME_LIMB
    shares = torch.exp(-distances.square()) * alike
    return ((shares / shares.sum(-1, keepdim=True))[..., None] * around).sum(1)


def fit_to_body(
    human: TriplaneHuman,
    surface: SurfaceSamples,
    spacing_m: float,
    *,
    steps: int,
    batch: int,
    generator: torch.Generator,
) -> None:
    """Make triplane and decoders say what the body is, at random points of its surface.

    No offset, the body's skinning weights, rotations that face along the normals, grey colour,
    opacity 0.1, and standard deviations of half of ``spacing_m``, the distance of neighbouring
    Gaussians, with the multiplier that they start with.
    """
    size = spacing_m * 0.5 / float(human.multipliers().median())
    decoders = [*human.geometry.parameters(), *human.appearance.parameters()]
    adam = Adam(
        [
            {"params": list(human.triplane.parameters()), "rate": TEXEL_RATE},
            {"params": decoders, "rate": DECODER_RATE},
            {"params": list(human.skinning.parameters()), "rate": DECODER_RATE},
        ],
        lr=DECODER_RATE,
    )
    targets = matrix_to_six(quaternion_to_matrix(facing(surface.normals)))
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = group["rate"] * max(1 - step / steps, 0.02)
        chosen = torch.randint(len(surface.points), (batch,), generator=generator)
        chosen = send(chosen, surface.points.device)
        found = human.look_up(surface.points[chosen])
        # Lengths count as shares of the size, or a centimetre would be too little to be learned.
        loss = (
            (found.offsets / size).square().mean()
            + (found.scales / size - 1).square().mean()
            + (found.six - targets[chosen]).square().mean()
            + (found.colours - START_COLOUR).square().mean()
            + (found.opacities - START_OPACITY).square().mean()
            + (found.weights - surface.weights[chosen]).square().sum(-1).mean()
        )
        adam.zero_grad()
        loss.backward()
        adam.step()
