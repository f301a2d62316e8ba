"""What stands on the floor before the walls of a known room, and how far away, by one picture.

It looks neither like the floor nor like the walls, ends at edges, and its neighbouring columns end
at about the same heights. What is upright is as far away as where it meets the floor (Hoiem, Efros
and Hebert, Automatic Photo Pop-up, SIGGRAPH 2005). Its front is upright up to the strongest edge
within it, from where a level seat leads back to what stands two thirds of the way to the wall, or
it leans back all the way to its upper end, half as far before the wall. One picture does not tell
which, and feet are known to a row or three, so the mean of both is taken.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, maximum_filter, uniform_filter1d
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.background import gone_on
from evsplat.methods.colour_shares import ColourShares
from evsplat.methods.line_directions import Lines, level_axes, step_to
from evsplat.methods.plane_sweep import enlarged
from evsplat.methods.room import REACH_M, SIDE_PX, Room, from_feet_m
from evsplat.methods.stixels import stixels

_ROUNDS = 3
_SURE, _PRICE, _ANYTHING = 3.0, 0.8, 0.1
"""Most that a pixel's colour says, as a logarithm of likelihoods, what furniture costs, and the
share of floor and walls that may look otherwise."""
_EDGE, _USUAL = 8.0, 0.7
"""Worth of an edge at a foot or an upper end, and how much of one makes an end neither likelier nor
less likely."""
_SHADES = (0.9, 0.8, 0.7)
"""Brightness of the floor in the shade of what stands on it."""
_RISE_M = 0.2
"""Least height at which a thing ends before the wall: skirting boards are lower."""
_FAR = 2.0
"""Weight of the floor far from the feet once things are known; what is near has 1 more."""
_CLEARANCE, _BODY_PX = 1.03, 7
"""Least depth of a thing as a share of the body's, and the square over which one of its points
counts."""
_RIM_PX, _CELL_PX, _WIDTH = 2, 2, 0.75
"""Width of a thing's rim, whose colours are in part its own; side of the squares of what is behind
it, of which each has a Gaussian, and its standard deviation in them."""
_LEADS_BACK, _BACK = 0.5, 0.65
"""Share of the way to the wall that the upper end of what leans, and the back of what has a seat,
are farther than the foot, in inverse depth."""
_AROUND, _LEVEL = 5, 0.02
"""Columns whose mean edge tells where a front ends, and the slope of sight from which on the top of
what is lower than the camera is seen."""


def furnished(
    camera: Camera, picture: Float[Tensor, "H W 3"], room: Room, body: Float[Tensor, "N 3"]
) -> Float[Tensor, "H W"]:
    """Depth as a share of the ``room``'s at each pixel; 1 where nothing stands before it.

    Nothing stands before the ``body``, which the ``picture`` does not show: its points, metres,
    wherever it went.
    """
    step = step_to(camera, SIDE_PX)
    lines = Lines.pooled(picture, camera, step)
    view = lines.camera
    shares = _shares(lines, room)
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


def _shares(lines: Lines, room: Room) -> Float[Tensor, "H W"]:
    """Depth of upright things as a share of the room's.

    At first floor is what is near the feet, and wall what is above the camera; colours of both and
    of things are found anew from round to round.
    """
    view = lines.camera
    planes = room.inverse(view.center(), pixel_rays(view))
    floor = (planes.argmax(-1) == 0).numpy()
    near = np.exp(-from_feet_m(view, planes[..., 0], room.feet, room.up) / REACH_M)
    colours, upright = ColourShares(lines.picture), _Upright.of(view, room)
    edges = upright.seen(_EDGE * (lines.strength * (1 - lines.along(room.up)) - _USUAL))
    edges = np.maximum(edges, np.concatenate([edges[1:], edges[-1:]]))
    edges[-1] = 0  # What leaves the picture ends at no edge.
    anything = colours.of(np.ones(floor.shape))
    surely, wall, thing = near, 1.0 * (planes[..., 0] < 0).numpy(), anything
    shares = torch.ones(floor.shape)
    for shades in [()] * (_ROUNDS - 1) + [_SHADES]:
        empty = np.where(floor, colours.of(surely * floor, shades), colours.of(wall))
        unlike = np.log(thing + 1e-9) - np.log((1 - _ANYTHING) * empty + 1e-9)
        gains = upright.seen(np.clip(unlike, -_SURE, _SURE) - _PRICE)
        shares = upright.shares(gains, edges)
        things = (shares < 1).numpy()
        thing = 0.5 * (colours.of(1.0 * things) + anything)
        surely, wall = (near + _FAR) * ~things, 1.0 * (~floor & ~things)
    return shares


@dataclass(frozen=True, eq=False)
class _Upright:
    """Columns of equal azimuth and rows of equal slope.

    In them what is upright stays in its column, however the camera is held.
    """

    inverse: Float[np.ndarray, "H W P"]
    """Inverse depth of the room's planes."""
    slopes: Float[np.ndarray, " H"]
    """Fall of the rows' sight per metre."""
    height_m: float
    """Of the camera above the floor."""
    risen: Bool[np.ndarray, "H W"]
    """Higher than `_RISE_M` before what stands behind the floor."""
    pixels: tuple[Int[np.ndarray, "H W"], Int[np.ndarray, "H W"]]
    """Row and column of the picture at each place."""
    inside: Bool[np.ndarray, "H W"]
    """Whether the picture shows it."""
    places: tuple[Int[np.ndarray, "H W"], Int[np.ndarray, "H W"]]
    """Row and column here of each pixel."""

    @staticmethod
    def of(view: Camera, room: Room) -> "_Upright":
        """As many of either as the picture has."""
        rays, up = pixel_rays(view), room.up
        right, ahead = level_axes(view, up, 0.0)
        azimuths = torch.atan2(rays @ right, rays @ ahead)
        slopes = -(rays @ up) / torch.hypot(rays @ right, rays @ ahead)
        columns, column = _cells(azimuths, view.width)
        rows, row = _cells(slopes, view.height)
        level = columns.sin()[:, None] * right + columns.cos()[:, None] * ahead
        directions = level - rows[:, None, None] * up
        inverse = room.inverse(view.center(), directions).numpy()
        x, y, _, inside = view.pixels(view.center() + directions)
        height_m = float(room.offsets[0] - room.normals[0] @ view.center())
        # Walls are upright: their inverse depth is the same in all of a column's rows.
        lowest = inverse[..., 1:].max(-1) * (height_m - _RISE_M)
        risen = rows.numpy()[:, None] < lowest
        return _Upright(
            inverse,
            rows.numpy(),
            height_m,
            risen,
            (y.numpy(), x.numpy()),
            inside.numpy(),
            (row.numpy(), column.numpy()),
        )

    def seen(self, values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
        """A picture's values here; 0 outside of it."""
        return np.where(self.inside, values[self.pixels], 0.0)

    def shares(
        self, gains: Float[np.ndarray, "H W"], edges: Float[np.ndarray, "H W"]
    ) -> Float[Tensor, "H W"]:
        """Of the picture's pixels, of what stands where it is likeliest, see `stixels`."""
        nearest, floor = self.inverse.max(-1), self.inverse.argmax(-1) == 0
        # Of an edge between a row and the one above.
        breaks = uniform_filter1d(np.roll(edges, 1, 0), _AROUND, axis=1)
        shares = np.ones_like(nearest)
        for at, ends in enumerate(stixels(gains, edges, floor, self.risen)):
            if ends is not None:
                top, foot = ends
                below = self.inverse[min(foot + 1, len(nearest) - 1), at, 0]
                strip, wall = slice(top, foot + 1), nearest[top, at]
                upright = self._front_and_seat(strip, below, wall, breaks[:, at])
                leaning = below + (wall - below) * np.linspace(_LEADS_BACK, 0, foot - top + 1)
                thing = (upright + leaning) / 2
                shares[strip, at] = np.minimum(nearest[strip, at] / thing, 1)
        return torch.from_numpy(shares[self.places]).float()

    def _front_and_seat(
        self, strip: slice, foot: float, wall: float, breaks: Float[np.ndarray, " H"]
    ) -> Float[np.ndarray, " R"]:
        """Inverse depth in the rows of a strip: of an upright front, a level seat, and a back.

        ``foot`` and ``wall``: that of the front, and of the wall behind. The front ends where
        ``breaks`` is most.
        """
        slopes = self.slopes[strip]
        risen = (slopes > _LEVEL) & (self.height_m - slopes / foot > _RISE_M)
        risen[:2] = False  # Edges at the upper end are its own.
        if not risen.any():
            return np.full(len(slopes), foot)
        end = np.where(risen, breaks[strip], -np.inf).argmax()
        seat = np.maximum(foot * slopes / slopes[end], foot + _BACK * (wall - foot))
        return np.where(np.arange(len(slopes)) < end, seat, foot)


def _cells(
    values: Float[Tensor, "H W"], count: int
) -> tuple[Float[Tensor, " N"], Int[Tensor, "H W"]]:
    """``count`` values all over their range, and which is nearest to each."""
    least, most = float(values.min()), float(values.max())
    cells = torch.linspace(least, most, count)
    step = max(most - least, 1e-9) / max(count - 1, 1)
    return cells, ((values - least) / step).round().long().clamp(0, count - 1)
