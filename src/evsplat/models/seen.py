"""How well pictures show each Gaussian of the person."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.models.at_rest import Skinned
from evsplat.render import render

_DRAWS = 4


def seen_squares(
    model: Skinned, views: Sequence[tuple[Camera, int]], *, seed: int = 0
) -> Float[Tensor, "H"]:
    """Squares of transmittance times alpha, summed over the pixels of all ``views``, in pixels.

    A Gaussian that alone makes up a pixel has 1 of it; one that shines through the front with a
    tenth has a hundredth, where the sum itself would count ten such pixels as one that is seen.
    The picture is linear in a channel of the Gaussians, and its derivative is transmittance times
    alpha: the square of the gradient of its pixels, summed with random signs, has this sum as its
    mean (Hutchinson 1990). ``views``: cameras and times, microseconds.
    """
    count = next(iter(model.sets.values())).human_count
    device = model.device
    generator = torch.Generator().manual_seed(seed)
    squares = torch.zeros(count, device=device)
    for camera, time_us in views:
        camera = camera.to(device)
        with torch.no_grad():
            layers = model.at([time_us], camera.center(), hard_semantics=True)
        channels = torch.zeros(1, count, _DRAWS, device=device, requires_grad=True)
        black = torch.zeros(*layers.scene.means.shape[:2], _DRAWS, device=device)
        drawn = render(
            replace(layers.human, channels=channels),
            camera,
            static=replace(layers.scene, channels=black),
            low_pass=layers.low_pass,
        )
        signs = torch.randint(0, 2, drawn.image.shape, generator=generator)
        (gradient,) = torch.autograd.grad(
            (drawn.image * (2 * signs - 1).to(device)).sum(), channels
        )
        squares += gradient[0].square().mean(-1)
    return squares
