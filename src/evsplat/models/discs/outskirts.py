"""Colours around the recorded pictures: what their rims say, where no pixel says anything else.

A recorded picture shows tails of the Gaussians beyond its borders, and Adam, which moves rows of
small gradients as far as any, makes a rainbow of them that cameras beside the recording ones see.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera, spread_over
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.surround import cell_px, continued
from evsplat.models.discs.scene_pictures import SEEN, ScenePictures
from evsplat.neighbours import nearest

STEPS = 16
"""Of conjugate gradients."""
PRICE = 1 / 800
"""What a squared difference to the rim's colours costs, in pixels of a cell of the surround."""
_BEYOND, _RIM = 0.25, 2.0
"""Cells beyond a border from which on a Gaussian is outside, and up to which from the border inside
colours may make up for what is missed of those."""
_HIDDEN, _AROUND = 0.02, 16
"""Squared shares of pixels below which a Gaussian within a picture is hidden; and of how many that
are seen a hidden one has the mean colour."""


def outskirts(
    gaussians: GaussianSet,
    recorded: Sequence[Camera],
    low_pass: float,
    colours: Float[Tensor, "S 3"] | None = None,
) -> Float[Tensor, "S 3"]:
    """The scene's own colours, sRGB; outside of all recorded pictures as the nearest one's rim.

    Behind furniture they are as what is seen about it.

    Those closest to that with which the pictures of the scene alone look as before (`closest`).
    What lies within any of them is changed by as little as that takes, and only near its border.
    ``recorded`` are cameras of one size along one way, of which some are drawn (`spread_over`).
    ``colours`` in place of those of ``gaussians``.
    """
    views = spread_over(recorded)
    pictures = ScenePictures(gaussians, views, low_pass, colours)
    own = pictures.colours
    cell = cell_px(views[0].width, views[0].height)
    least = torch.stack([pictures.cells_beyond(camera) for camera in recorded]).amin(0)
    outside, near = least > _BEYOND, least > -_RIM
    closest_view = torch.stack([pictures.cells_beyond(view) for view in views]).argmin(0)
    told = own.clone()
    for index, (view, picture) in enumerate(zip(views, pictures.before, strict=True)):
        rows = outside & (closest_view == index)
        places = view.project(pictures.means)[0]
        told[rows] = continued(picture[0].cpu(), places[rows].cpu(), cell).to(own.device)
    shown = ~outside & (pictures.squares > SEEN)
    # What one of several views hides another may show.
    if len(views) == 1 and shown.sum() >= _AROUND:
        hidden = ~near & (pictures.squares < _HIDDEN) & pictures.behind(views[0])
        _, around = nearest(pictures.means[shown], _AROUND, pictures.means[hidden])
        told[hidden] = own[shown][around].mean(1)
        near = near | hidden
    return pictures.near(told, near, PRICE * cell**2, STEPS)
