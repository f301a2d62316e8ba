"""Colours around the recorded pictures: what their rims say, where no pixel says anything else.

A recorded picture shows tails of the Gaussians beyond its borders, and Adam, which moves rows of
small gradients as far as any, makes a rainbow of them that cameras beside the recording ones see.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, reduce
from operator import add

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.surface_graph import closest
from evsplat.gaussians.surround import cell_px, continued
from evsplat.models.discs.first_colours import LEAST, MOST
from evsplat.models.discs.still import Still
from evsplat.models.seen import fixed, shares_by, transposed
from evsplat.neighbours import nearest
from evsplat.render import Splats, render

MOST_VIEWS = 12
"""Pictures of a moving camera that are drawn."""
STEPS = 16
"""Of conjugate gradients."""
PRICE = 1 / 800
"""What a squared difference to the rim's colours costs, in pixels of a cell of the surround."""
_BEYOND, _RIM = 0.25, 2.0
"""Cells beyond a border from which on a Gaussian is outside, and up to which from the border inside
colours may make up for what is missed of those."""
_FAST = 1e6
_HIDDEN, _SEEN, _AROUND = 0.02, 0.1, 16
"""Squared shares of pixels below which a Gaussian within a picture is hidden, and from which it is
seen; and of how many that are seen a hidden one has the mean colour."""
_FARTHER = 1.15
"""Its least depth as a share of the picture's there."""


def outskirts(
    gaussians: GaussianSet, recorded: Sequence[Camera], low_pass: float
) -> Float[Tensor, "S 3"]:
    """The scene's own colours, sRGB; outside of all recorded pictures as the nearest one's rim.

    Behind furniture they are as what is seen about it.

    Those closest to that with which the pictures of the scene alone look as before (`closest`).
    What lies within any of them is changed by as little as that takes, and only near its border.
    ``recorded`` are cameras of one size along one way, of which at most `MOST_VIEWS` are drawn.
    """
    drawn = torch.linspace(0, len(recorded) - 1, min(MOST_VIEWS, len(recorded))).round().int()
    views = [recorded[index] for index in drawn.tolist()]
    with torch.no_grad():
        scene = Still.of(gaussians, None, hard_semantics=True).scene.with_times()
    scene = fixed(scene, scene.channels[..., :3])
    own = scene.channels[0]
    pictures = [partial(_drawn, scene, view, low_pass) for view in views]

    def seen(values: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3"]:
        return _over(pictures, values, lambda drawn, _: drawn)

    with torch.no_grad():
        before = [draw(own[None]) for draw in pictures]
    cell = cell_px(views[0].width, views[0].height)
    least = torch.stack([_cells_beyond(scene, camera, cell) for camera in recorded]).amin(0)
    outside, near = least > _BEYOND, least > -_RIM
    closest_view = torch.stack([_cells_beyond(scene, view, cell) for view in views]).argmin(0)
    told = own.clone()
    for index, (view, picture) in enumerate(zip(views, before, strict=True)):
        rows = outside & (closest_view == index)
        places = view.project(scene.means[0])[0]
        told[rows] = continued(picture[0].cpu(), places[rows].cpu(), cell).to(own.device)
    generator = torch.Generator().manual_seed(0)
    shares = [shares_by(draw, scene.means, generator) for draw in pictures]
    squares = reduce(add, [each[:, 1:].square().mean(1) for each in shares])
    shown = ~outside & (squares > _SEEN)
    # What one of several views hides another may show.
    if len(views) == 1 and shown.sum() >= _AROUND:
        hidden = ~near & (squares < _HIDDEN) & _behind(scene, views[0], pictures[0])
        points = scene.means[0]
        _, around = nearest(points[shown], _AROUND, points[hidden])
        told[hidden] = own[shown][around].mean(1)
        near = near | hidden
    missing = _over(pictures, told, lambda drawn, index: before[index] - drawn)
    price = torch.where(near, PRICE * cell**2, _FAST).to(own)
    colours = closest(told, missing, seen, squares, price, torch.zeros_like(price), STEPS)
    return torch.where(near[:, None], colours.clamp(LEAST, MOST), own)


def _behind(scene: Splats, view: Camera, draw: Callable[[Tensor], Tensor]) -> Bool[Tensor, " S"]:
    """What lies well behind the depth that the picture has there."""
    x, y, depth, inside = view.pixels(scene.means[0])
    with torch.no_grad():
        sums = draw(torch.stack([depth, torch.ones_like(depth)], -1)[None])[0]
    depths, shares = sums[y, x].unbind(-1)
    return inside & (depth * shares > _FARTHER * depths)


def _drawn(
    scene: Splats, view: Camera, low_pass: float, values: Float[Tensor, "1 S C"]
) -> Float[Tensor, "1 H W C"]:
    return render(replace(scene, channels=values), view, low_pass=low_pass).image


def _over(
    pictures: Sequence[Callable[[Tensor], Tensor]],
    values: Float[Tensor, "S 3"],
    weights: Callable[[Tensor, int], Tensor],
) -> Float[Tensor, "S 3"]:
    """Sum over all pictures of ``J^T weights``, of a picture with these values and its number."""
    sums: list[Tensor] = []
    for index, draw in enumerate(pictures):
        leaf = values[None].clone().requires_grad_()
        image = draw(leaf)
        sums.append(transposed(image, leaf, weights(image.detach(), index))[0])
    return reduce(add, sums)


def _cells_beyond(scene: Splats, view: Camera, cell: int) -> Float[Tensor, " S"]:
    """Cells from the border of a picture to each centre outside; negative within."""
    places, depth = view.project(scene.means[0])
    size = places.new_tensor([view.width, view.height])
    beyond = ((places - size / 2).abs() - size / 2).amax(-1) / cell
    return beyond.where(depth > 0, torch.inf)
