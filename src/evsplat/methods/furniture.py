"""What stands on the floor before the walls of a known room, and how far away, by one picture.

It looks neither like the floor nor like the walls. What is upright is as far away as where it meets
the floor (Hoiem, Efros and Hebert, Automatic Photo Pop-up, SIGGRAPH 2005); as seats and table tops
lead back to the wall, its upper end is taken to be half as far before it.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, binary_opening, gaussian_filter, label, maximum_filter
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.background import gone_on
from evsplat.methods.colour_shares import ColourShares
from evsplat.methods.line_directions import level_axes
from evsplat.methods.plane_sweep import enlarged, pooled
from evsplat.methods.room import Room, from_feet_m

SIDE_PX = 128
"""Shorter side, about, of the picture that is looked at."""
_ROUNDS = 3
_SURE, _PRICE, _ANYTHING = 4.0, 0.5, 0.1
"""Most that a pixel's colour says, as a logarithm of likelihoods, what furniture costs, and the
share of floor and walls that may look otherwise."""
_REACHES_M = 0.4, 0.7, 1.0
"""Ways from the feet in which the floor's colours count 1 / e as much."""
_FAR = 2.0
"""Weight of the floor far from the feet once things are known; what is near has 1 more."""
_BLUR_PX = 1.2
_LEAST_PX = 20
"""Of a thing, before the floor."""
_CLEARANCE, _BODY_PX = 1.03, 7
"""Least depth of a thing as a share of the body's, and the square over which one of its points
counts."""
_RIM_PX, _CELL_PX, _WIDTH = 2, 2, 0.75
"""Width of a thing's rim, whose colours are in part its own; side of the squares of what is behind
it, of which each has a Gaussian, and its standard deviation in them."""
_GAP, _LEAST_ROWS = 3, 4
"""Rows without it that a thing may have, and that it must have."""
_LEADS_BACK = 0.5
"""Share of the way to the wall that its upper end is farther than its foot, in inverse depth."""


def furnished(
    camera: Camera, picture: Float[Tensor, "H W 3"], room: Room, body: Float[Tensor, "N 3"]
) -> Float[Tensor, "H W"]:
    """Depth as a share of the ``room``'s at each pixel; 1 where nothing stands before it.

    Nothing stands before the ``body``, which the ``picture`` does not show: its points, metres,
    wherever it went.
    """
    step = max(1, round(min(camera.width, camera.height) / SIDE_PX))
    view = camera.smaller(step, whole=False)
    shares = _likeliest(pooled(picture, step).double().numpy(), room, view)
    least = _CLEARANCE * _farthest_m(body, view) / room.depth(view)
    shares = torch.maximum(shares, least).clamp_max(1)
    return enlarged(shares, step)[: camera.height, : camera.width]


def behind_things(
    camera: Camera,
    picture: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    shares: Float[Tensor, "H W"],
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Places, scales and colours of floor and walls behind things, which a camera beside sees.

    ``depth``: of floor and walls, metres; ``shares``: see `furnished`. Colours, sRGB, go on from
    around the things.
    """
    things = torch.from_numpy(binary_dilation((shares < 1).numpy(), iterations=_RIM_PX))
    goes_on = gone_on(picture, ~things)
    cells = things[::_CELL_PX, ::_CELL_PX].nonzero() * _CELL_PX
    y, x = cells.unbind(-1)
    away = depth[y, x, None]
    places = camera.center() + away * pixel_rays(camera)[y, x]
    scales = (_WIDTH * _CELL_PX * away / camera.K[0, 0]).repeat(1, 3)
    return places, scales, goes_on[y, x]


def _farthest_m(body: Float[Tensor, "N 3"], view: Camera) -> Float[Tensor, "H W"]:
    """Depth of the farthest of the body's points about each pixel; 0 where it never was."""
    x, y, depth, inside = view.pixels(body)
    farthest = torch.zeros(view.height * view.width)
    at = (y * view.width + x)[inside]
    farthest.scatter_reduce_(0, at, depth[inside].float(), "amax")
    spread = maximum_filter(farthest.view(view.height, view.width).numpy(), _BODY_PX)
    return torch.from_numpy(spread)


def _likeliest(
    picture: Float[np.ndarray, "H W 3"], room: Room, view: Camera
) -> Float[Tensor, "H W"]:
    """Shares of the things that explain the picture's colours best.

    Somebody may have stood near a thing or far from it, so that several ways from the feet are
    tried in which there is surely floor.
    """
    planes = room.inverse(view.center(), pixel_rays(view))
    floor = (planes.argmax(-1) == 0).numpy()
    feet_m = from_feet_m(view, planes[..., 0], room.feet, room.up)
    colours = ColourShares(picture)
    above = (planes[..., 0] < 0).numpy()
    told = (_told(colours, floor, np.exp(-feet_m / reach), above) for reach in _REACHES_M)
    found = [_shares(things, view, room) for things in told]
    return max(found, key=lambda shares: _explained(colours, floor, (shares < 1).numpy()))


def _told(
    colours: ColourShares,
    floor: Bool[np.ndarray, "H W"],
    near: Float[np.ndarray, "H W"],
    above: Bool[np.ndarray, "H W"],
) -> Bool[np.ndarray, "H W"]:
    """Things, where at first floor is what is ``near`` the feet, and wall what is above the camera.

    Colours of the three are found anew from round to round.
    """
    anything = colours.of(np.ones(floor.shape))
    things, thing = np.zeros_like(floor), anything
    surely, wall = near, above
    for _ in range(_ROUNDS):
        empty = np.where(floor, colours.of(surely * floor), colours.of(1.0 * wall))
        unlike = np.log(thing + 1e-9) - np.log((1 - _ANYTHING) * empty + 1e-9)
        unlike = gaussian_filter(np.clip(unlike, -_SURE, _SURE), _BLUR_PX) - _PRICE
        things = _standing(binary_opening(unlike > 0, np.ones((2, 2))), floor)
        thing = 0.5 * (colours.of(1.0 * things) + anything)
        surely, wall = (near + _FAR) * ~things, ~floor & ~things
    return things


def _explained(
    colours: ColourShares, floor: Bool[np.ndarray, "H W"], things: Bool[np.ndarray, "H W"]
) -> float:
    """Logarithm of the likelihood of all colours in three parts of the picture."""
    parts = things, floor & ~things, ~floor & ~things
    told = sum(float(np.log(colours.of(1.0 * part)[part] + 1e-9).sum()) for part in parts)
    return told - _PRICE * float(things.sum())


def _standing(
    things: Bool[np.ndarray, "H W"], floor: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Those of which enough is seen before the floor."""
    numbers, count = label(things, np.ones((3, 3)))
    before_floor = np.bincount(numbers[floor], minlength=count + 1)
    stands = before_floor >= _LEAST_PX
    stands[0] = False
    return stands[numbers]


def _shares(things: Bool[np.ndarray, "H W"], view: Camera, room: Room) -> Float[Tensor, "H W"]:
    """Depth of upright things as a share of the room's.

    Of columns and rows of equal azimuth and of equal slope, in which what is upright stays in its
    column, however the camera is held.
    """
    rays, up = pixel_rays(view), room.up
    right, ahead = level_axes(view, up, 0.0)
    azimuths = torch.atan2(rays @ right, rays @ ahead)
    slopes = -(rays @ up) / torch.hypot(rays @ right, rays @ ahead)
    columns, column = _cells(azimuths, things.shape[1])
    rows, row = _cells(slopes, things.shape[0])
    level = columns.sin()[:, None] * right + columns.cos()[:, None] * ahead
    directions = level - rows[:, None, None] * up
    inverse = room.inverse(view.center(), directions)
    nearest = inverse.amax(-1)
    x, y, _, inside = view.pixels(view.center() + directions)
    there = torch.from_numpy(things)[y, x] & inside
    shares = torch.ones_like(nearest)
    for at in range(len(columns)):
        for top, foot in _runs(there[:, at].numpy()):
            on_floor = inverse[foot].argmax(-1)[at] == 0 and inverse[top].argmax(-1)[at] > 0
            if not on_floor:
                continue
            below = inverse[min(foot + 1, len(rows) - 1), at, 0]
            back = _LEADS_BACK * torch.linspace(1, 0, foot - top + 1)
            thing = torch.lerp(below, nearest[top, at], back)
            shares[top : foot + 1, at] = (nearest[top : foot + 1, at] / thing).clamp_max(1)
    return torch.where(torch.from_numpy(things), shares[row, column], 1.0)


def _cells(
    values: Float[Tensor, "H W"], count: int
) -> tuple[Float[Tensor, " N"], Int[Tensor, "H W"]]:
    """``count`` values all over their range, and which is nearest to each."""
    least, most = float(values.min()), float(values.max())
    cells = torch.linspace(least, most, count)
    step = max(most - least, 1e-9) / max(count - 1, 1)
    return cells, ((values - least) / step).round().long().clamp(0, count - 1)


def _runs(there: Bool[np.ndarray, " N"]) -> Iterator[tuple[int, int]]:
    """First and last row of each thing in a column."""
    rows = there.nonzero()[0]
    for run in np.split(rows, (np.diff(rows) > _GAP).nonzero()[0] + 1):
        if len(run) and run[-1] - run[0] + 1 >= _LEAST_ROWS:
            yield int(run[0]), int(run[-1])
