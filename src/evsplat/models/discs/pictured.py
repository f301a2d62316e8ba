"""Colours within the recorded picture: as it has them, where it hardly tells them of a Gaussian.

Several lie over each other in one pixel, and what they must look like together one picture tells,
each of them not. Training makes one too bright and the next too dark, or too red and too green,
which is speckle as soon as a camera looks from beside.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.models.discs.scene_pictures import ScenePictures

STEPS = 30
"""Of conjugate gradients."""
PRICE = 1 / 2000
"""What a squared difference to the picture's colour costs, in pixels."""


def pictured(gaussians: GaussianSet, recorded: Camera, low_pass: float) -> Float[Tensor, "S 3"]:
    """The scene's own colours, sRGB; within the picture close to those that it shows there.

    Those closest with which the picture of the scene alone looks as before (`closest`), begun at
    the own ones: where it ends early, the picture is what stays. What is outside, or hidden well
    behind what is seen, keeps its own.
    """
    pictures = ScenePictures(gaussians, [recorded], low_pass)
    own = pictures.colours
    within = (pictures.cells_beyond(recorded) < 0) & ~pictures.behind(recorded)
    told = torch.where(within[:, None], _colours_at(pictures, recorded), own)
    return pictures.near(told, within, PRICE, STEPS, own)


def _colours_at(pictures: ScenePictures, view: Camera) -> Float[Tensor, "S 3"]:
    """Of the picture where each Gaussian's centre is, between pixels; at its rim outside of it."""
    places = view.project(pictures.means)[0]
    size = places.new_tensor([view.width, view.height])
    grid = (2 * places / size - 1)[None, None]
    picture = pictures.before[0].movedim(-1, 1)
    at = F.grid_sample(picture, grid, padding_mode="border", align_corners=False)
    return at[0, :, 0].T.contiguous()
