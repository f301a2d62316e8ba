"""Colours around the recorded picture: what its rim says, where no pixel says anything else.

The recorded picture shows tails of the Gaussians beyond its borders, and Adam, which moves rows of
small gradients as far as any, makes a rainbow of them that cameras beside the recording one see.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.surface_graph import closest
from evsplat.gaussians.surround import cell_px, continued
from evsplat.models.discs.first_colours import LEAST, MOST
from evsplat.models.discs.still import Still
from evsplat.models.seen import fixed, shares_by, transposed
from evsplat.render import render

STEPS = 16
"""Of conjugate gradients."""
PRICE = 1 / 800
"""What a squared difference to the rim's colours costs, in pixels of a cell of the surround."""
_BEYOND, _RIM = 0.25, 2.0
"""Cells beyond a border from which on a Gaussian is outside, and up to which from the border inside
colours may make up for what is missed of those."""
_FAST = 1e6


def outskirts(gaussians: GaussianSet, recording: Camera, low_pass: float) -> Float[Tensor, "S 3"]:
    """The scene's own colours, sRGB; outside of the recorded picture as its rim goes on.

    Those closest to that with which the recorded picture of the scene alone looks as before
    (`closest`). What lies within is changed by as little as that takes, and only near the border.
    """
    with torch.no_grad():
        scene = Still.of(gaussians, None, hard_semantics=True).scene.with_times()
    scene = fixed(scene, scene.channels[..., :3])
    own = scene.channels[0]

    def drawn(values: Float[Tensor, "1 S C"]) -> Float[Tensor, "1 H W C"]:
        return render(replace(scene, channels=values), recording, low_pass=low_pass).image

    def picture(values: Float[Tensor, "S 3"]) -> tuple[Tensor, Tensor]:
        leaf = values[None].clone().requires_grad_()
        return leaf, drawn(leaf)

    def seen(values: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3"]:
        leaf, image = picture(values)
        return transposed(image, leaf, image.detach())[0]

    with torch.no_grad():
        before = drawn(own[None])
    places = recording.project(scene.means[0])[0]
    size = places.new_tensor([recording.width, recording.height])
    cell = cell_px(recording.width, recording.height)
    beyond = ((places - size / 2).abs() - size / 2).amax(-1) / cell
    outside, near = beyond > _BEYOND, beyond > -_RIM
    told = own.clone()
    rim = continued(before[0].cpu(), places[outside].cpu(), cell)
    told[outside] = rim.to(own.device)
    leaf, image = picture(told)
    missing = transposed(image, leaf, before - image.detach())[0]
    shares = shares_by(drawn, scene.means, torch.Generator().manual_seed(0))
    price = torch.where(near, PRICE * cell**2, _FAST).to(own)
    squares = shares[:, 1:].square().mean(1)
    colours = closest(told, missing, seen, squares, price, torch.zeros_like(price), STEPS)
    return torch.where(near[:, None], colours.clamp(LEAST, MOST), own)
