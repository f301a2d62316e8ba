"""Floor and walls of a room, told by one picture of it and by where the person went.

Edges tell how the walls are turned. Of all boxes of that turn that hold the person the one is taken
whose floor looks like what lies under the feet and whose walls look like what is above the camera,
whose surfaces have no edges along their normals (Lee, Hebert and Kanade, Geometric Reasoning for
Single Image Structure Recovery, CVPR 2009) and whose creases are edges (Hedau, Hoiem and Forsyth,
Recovering the Spatial Layout of Cluttered Rooms, ICCV 2009).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, uniform_filter
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians.initialise import extremes, pixel_rays
from evsplat.methods.colour_shares import ColourShares
from evsplat.methods.line_directions import Lines, level_axes, step_to, wall_turn

SIDE_PX, FINE_PX = 128, 256
"""Shorter sides, about, of the picture that tells a room and of the one that tells its place."""
LEAST_AGREEMENT = 0.4
"""Of edges with the walls' directions: of edges of any direction it is 0.25."""
_LOWEST_M, _STEEPEST = 0.2, 0.9
"""Least height of the camera above the floor, and sine of its steepest view."""
_CLEARANCE, _LEAST_M = 1.03, 0.3
"""Least distance of a wall as a share of how far the body reaches there, which counts so much."""
_FARTHEST, _DISTANCES = (3.0, 6.0, 6.0), 24
"""Farthest walls ahead, left and right, as shares of the nearest, and how many are tried."""
_REFINED = 4
"""Distances that are tried in the end on each side, up to the next one."""
_ROUNDS = 3
_FEET_M, _FEET = 0.25, 256
"""Height up to which a point of the body is of its feet, and how many of them count."""
_SOLE_M = 0.02
"""By which a body, which is bare, stands above the floor."""
REACH_M = 0.7
"""Way from the feet in which the floor's colours count 1 / e as much."""
_ANYTHING = 0.1
"""Share of a surface that may look like anything in the picture."""
_SURE = 3.0
"""Logarithm of likelihoods beyond which a pixel is no surer."""
_FLOOR_PRICE = 0.3
"""Of a pixel of floor, as such a logarithm: of two walls the nearer one."""
_EDGE, _STANDING = 3.0, 4.5
"""Prices of an edge along the normal of a wall, and of the floor."""
_CREASE, _USUAL = 5.0, 0.12
"""Worth of an edge along a crease, and how much of one there is anywhere."""
_SKIRTING_M, _STEPS = 0.15, 24
"""Height of what may run along the foot of a wall, and how many heights up to it are tried."""
_STEPS_BLUR = 1.5
"""In such steps: a line crosses pixels by chance."""
_FAINT = 0.5
"""Share of the edges at a skirting board's upper end that are enough at its lower one."""
_NO_WAY = 0.2
"""Weight with which an edge has none of the three directions."""

_ALONG, _AHEAD, _UP = range(3)
_NONE = -1
_BETWEEN = np.array(
    [
        [_NONE, _ALONG, _AHEAD, _AHEAD],
        [_ALONG, _NONE, _UP, _UP],
        [_AHEAD, _UP, _NONE, _UP],
        [_AHEAD, _UP, _UP, _NONE],
    ]
)
"""Direction of the crease between two of floor and walls ahead, left and right."""


@dataclass(frozen=True, eq=False)
class Room:
    """A floor, a wall ahead and up to two beside: all where ``normals @ x <= offsets``."""

    normals: Float[Tensor, "P 3"]
    """Of length 1, out of the room; the floor's and that of the wall ahead come first."""
    offsets: Float[Tensor, " P"]
    """Metres."""
    feet: Float[Tensor, "N 3"]
    """Where the person stood."""

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Away from the floor."""
        return -self.normals[0]

    def depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Of what each pixel's ray meets, metres.

        At most six times as far as the wall ahead, which the outermost rays of a wide camera miss.
        """
        ahead = self.offsets[1] - self.normals[1] @ camera.center()
        inverse = self.inverse(camera.center(), pixel_rays(camera)).amax(-1)
        return 1 / inverse.clamp_min(1 / (6 * float(ahead)))

    def inverse(
        self, center: Float[Tensor, "3"], directions: Float[Tensor, "*N 3"]
    ) -> Float[Tensor, "*N P"]:
        """Of how many ``directions`` it is from ``center`` to each plane; negative behind."""
        return directions @ self.normals.T / (self.offsets - self.normals @ center)


def find_room(
    camera: Camera,
    picture: Float[Tensor, "H W 3"],
    body: Float[Tensor, "N 3"],
    up: Float[Tensor, "3"],
) -> Room | None:
    """The room that holds all points of the ``body``, metres, by its ``picture`` without them.

    ``picture``: sRGB in [0, 1]. ``up``: unit vector. None where edges along ``up`` and two
    directions at right angles to it are no rule, as out of doors, and for a camera that lies on the
    floor or looks down at it.
    """
    floor_m = extremes(camera, [body], up)[1] - _SOLE_M
    height_m = float(camera.center() @ up) - floor_m
    steep = abs(float(camera.world_to_camera[2, :3] @ up)) > _STEEPEST
    if steep or height_m < _LOWEST_M:
        return None
    coarse, fine = (
        Lines.pooled(picture, camera, step_to(camera, side_px)) for side_px in (SIDE_PX, FINE_PX)
    )
    turn, agreement = wall_turn(coarse, up)
    if agreement < LEAST_AGREEMENT:
        return None
    along, ahead = level_axes(camera, up, turn)
    feet = body[body @ up < floor_m + _FEET_M]
    stage = _Stage((along, ahead, up), floor_m, feet[:: -(-len(feet) // _FEET)])
    normals, center = stage.normals, camera.center()
    reach = ((body - center) @ normals[1:].T).amax(0).tolist()
    nearest = [_CLEARANCE * max(each, _LEAST_M) for each in reach]
    away = _Surfaces.of(coarse, stage).cheapest(nearest)
    away = _Surfaces.of(fine, stage).at_the_foot(away, nearest, height_m)
    offsets = torch.tensor([-floor_m, *away])
    offsets[1:] += normals[1:] @ center
    there = offsets.isfinite()
    return Room(normals[there], offsets[there], stage.feet)


@dataclass(frozen=True, eq=False)
class _Stage:
    """What is known of a room before its walls."""

    axes: tuple[Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"]]
    """Along the wall ahead, into it, and upright."""
    floor_m: float
    feet: Float[Tensor, "N 3"]

    @property
    def normals(self) -> Float[Tensor, "4 3"]:
        """Of floor and walls ahead, left and right, out of the room."""
        along, ahead, up = self.axes
        return torch.stack([-up, ahead, -along, along])

    def inverse_depth(self, camera: Camera) -> Float[Tensor, "4 H W"]:
        """Of the floor, and of walls one metre away from the camera."""
        height = float(camera.center() @ self.axes[_UP]) - self.floor_m
        inverse = pixel_rays(camera) @ self.normals.T / torch.tensor([height, 1, 1, 1])
        return inverse.movedim(-1, 0)


def from_feet_m(
    camera: Camera, floor: Float[Tensor, "H W"], feet: Float[Tensor, "N 3"], up: Float[Tensor, "3"]
) -> Float[np.ndarray, "H W"]:
    """Way from the nearest of the feet to each pixel of the floor, whose inverse depth is given.

    Infinite above the horizon.
    """
    below = floor > 0
    there = camera.center() + pixel_rays(camera)[below] / floor[below][:, None]
    there, feet = (points - (points @ up)[:, None] * up for points in (there, feet))
    distances = torch.full_like(floor, torch.inf)
    distances[below] = torch.cdist(there, feet).amin(-1)
    return distances.numpy()


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """What speaks for floor and walls ahead, left and right, and for creases between them."""

    inverse: Float[np.ndarray, "4 H W"]
    """See `_Stage.inverse_depth`."""
    prices: Float[np.ndarray, "4 H W"]
    """Of taking a pixel for each."""
    beside: Float[np.ndarray, "3 H W1"]
    """How much of an edge along each axis is between a pixel and the next."""
    below: Float[np.ndarray, "3 H1 W"]

    @staticmethod
    def of(lines: Lines, stage: _Stage) -> "_Surfaces":
        """By one picture."""
        edges = _edges(lines, stage.axes)
        along, ahead, upright = edges
        inverse = stage.inverse_depth(lines.camera)
        feet_m = from_feet_m(lines.camera, inverse[0], stage.feet, stage.axes[_UP])
        likely = _floor_likelihood(lines.picture, inverse[0].numpy(), feet_m)
        floor = _STANDING * upright + _FLOOR_PRICE - likely
        prices = np.stack([floor, _EDGE * ahead, _EDGE * along, _EDGE * along])
        beside = np.maximum(edges[..., :-1], edges[..., 1:])
        below = np.maximum(edges[:, :-1], edges[:, 1:])
        return _Surfaces(inverse.numpy(), prices, beside, below)

    def cheapest(self, nearest_m: Sequence[float]) -> list[float]:
        """Distances of the three walls from the camera, metres; infinite where there is none.

        None is less than ``nearest_m``. Each is chosen while the others stay, in turns, the wall
        ahead first and without walls at the sides.
        """
        ahead, *sides = map(_distances, nearest_m, _FARTHEST)
        tried = [ahead, *([math.inf, *side] for side in sides)]
        best = self._settled([math.inf] * 3, tried)
        return self._settled(best, [_around(*pair) for pair in zip(best, tried, strict=True)])

    def at_the_foot(
        self, away_m: Sequence[float], nearest_m: Sequence[float], height_m: float
    ) -> list[float]:
        """Walls nearer where they were taken to stand on the upper end of a skirting board.

        It looks like the end of the floor as its lower end does, and often more so. ``height_m``:
        of the camera above the floor.
        """
        found = list(away_m)
        for wall, (away, nearest) in enumerate(zip(away_m, nearest_m, strict=True)):
            if math.isfinite(away):
                lowered = max(nearest, away * (1 - min(_SKIRTING_M / height_m, 0.5)))
                tried = np.linspace(away, lowered, _STEPS).tolist()
                rooms = ([*found[:wall], place, *found[wall + 1 :]] for place in tried)
                edges = gaussian_filter([self._foot(room, wall) for room in rooms], _STEPS_BLUR)
                enough = _FAINT * edges[: _STEPS // 4].max()
                found[wall] = tried[_last_peak(edges, enough)]
        return found

    def price(self, away_m: Sequence[float]) -> float:
        """Of a room whose walls are so far away."""
        seen = self._seen(away_m)
        total = float(np.take_along_axis(self.prices, seen[None], 0).sum())
        return total - sum(
            _CREASE * float((edges - _USUAL).sum()) for *_, edges in self._creases(seen)
        )

    def _foot(self, away_m: Sequence[float], wall: int) -> float:
        """How much of an edge is where a wall meets the floor."""
        return sum(
            float(edges[(first == 0) & (second == wall + 1)].sum())
            for first, second, edges in self._creases(self._seen(away_m))
        )

    def _seen(self, away_m: Sequence[float]) -> Int[np.ndarray, "H W"]:
        """Which of floor and walls is at each pixel."""
        return (self.inverse / np.array([1.0, *away_m])[:, None, None]).argmax(0)

    def _creases(
        self, seen: Int[np.ndarray, "H W"]
    ) -> Iterator[tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, " N"]]]:
        """Pairs of surfaces, the floor first, that meet between pixels, and the edges there."""
        for edges, one, other in (
            (self.beside, seen[:, :-1], seen[:, 1:]),
            (self.below, seen[:-1], seen[1:]),
        ):
            y, x = np.nonzero(one != other)
            pair = np.sort([one[y, x], other[y, x]], 0)
            yield pair[0], pair[1], edges[_BETWEEN[pair[0], pair[1]], y, x]

    def _settled(self, away_m: list[float], tried: Sequence[Sequence[float]]) -> list[float]:
        for _ in range(_ROUNDS):
            before = away_m
            for wall, places in enumerate(tried):
                rooms = ([*away_m[:wall], place, *away_m[wall + 1 :]] for place in places)
                away_m = min(rooms, key=self.price)
            if away_m == before:
                break
        return away_m


def _last_peak(values: Float[np.ndarray, " N"], enough: float) -> int:
    """Of those above ``enough`` that are no less than what lies beside; else the first."""
    inner = values[1:-1]
    peaks = (inner > enough) & (inner >= values[:-2]) & (inner >= values[2:])
    return int(peaks.nonzero()[0][-1]) + 1 if peaks.any() else 0


def _distances(nearest: float, farthest: float) -> list[float]:
    """Evenly spaced in what they displace a picture by, up to ``farthest`` times the nearest."""
    inverse: np.ndarray = np.linspace(1, 1 / farthest, _DISTANCES)
    return (nearest / inverse).tolist()


def _around(chosen: float, tried: Sequence[float]) -> list[float]:
    """Distances up to the ones next to what was chosen."""
    if math.isinf(chosen):
        return [chosen]
    nearest, farthest = (1 / end for end in (min(tried), sorted(tried)[_DISTANCES - 1]))
    step = (nearest - farthest) / (_DISTANCES - 1)
    shares = np.arange(-_REFINED, _REFINED + 1) / (_REFINED + 1)
    inverse = np.clip(1 / chosen + step * shares, farthest, nearest)
    return (1 / inverse).tolist()


def _edges(lines: Lines, axes: Sequence[Float[Tensor, "3"]]) -> Float[np.ndarray, "3 H W"]:
    """How far each pixel is an edge along each of the axes rather than along the others."""
    agree = np.stack([lines.along(axis) for axis in axes])
    edges: Float[np.ndarray, "3 H W"] = (
        lines.strength * agree.max(0) * agree / (agree.sum(0) + _NO_WAY)
    )
    return edges


def _floor_likelihood(
    picture: Float[np.ndarray, "H W 3"],
    inverse: Float[np.ndarray, "H W"],
    from_feet_m: Float[np.ndarray, "H W"],
) -> Float[np.ndarray, "H W"]:
    """Logarithm of how much likelier each pixel's colour is on the floor than on a wall.

    Floor is what lies near the feet, wall what is above the camera's height.
    """
    colours = ColourShares(picture)
    anything = colours.of(np.ones_like(inverse))
    floor = colours.of(np.exp(-from_feet_m / REACH_M))
    wall = colours.of(1.0 * (inverse < 0))
    mixed = ((1 - _ANYTHING) * share + _ANYTHING * anything for share in (floor, wall))
    ratio = np.subtract(*(np.log(each + 1e-12) for each in mixed))
    likelihood: Float[np.ndarray, "H W"] = np.clip(uniform_filter(ratio, 3), -_SURE, _SURE)
    return likelihood
