"""Landmarks of one person in one picture: a square region of it, read by the network in copies.

As MediaPipe does (its graph `pose_landmark_by_roi`), the region is turned so that the person is
upright, the points are refined by the heat map around them, and two points that the network adds
span the region in which the person is looked for next.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from evsplat.landmarks.landmarks import BLAZEPOSE_33, LIMB_POINTS
from evsplat.landmarks.network import HEAT_SIDE, POINTS, SIDE, LandmarkNetwork, NetworkOutput

_CENTRE, _RIM = 33, 34
"""Points of the network between the hips, and as far from it as a circle around the person."""
_MARGIN = 1.25
COPIES = ((0.0, False), (0.0, True), (-0.25, False), (0.25, True))
"""Turns (radians) and mirroring of the copies that are read: those that are turned disagree with
the others where a point is hidden."""
_HEAT_REACH = 3
"""Cells on each side of a point whose heat refines it."""
_LEAST_HEAT = 0.5
LEAST_FLAG = 0.5
"""Below it there is no person in a region, says the network."""
MOST_DOUBT = 0.015
"""Beyond it neither, whatever the flag: of an empty room it can be 0.9 where one looks for long."""


def _other_side(name: str) -> str:
    swap = {"left": "right", "right": "left"}
    return "_".join(swap.get(part, part) for part in name.split("_"))


_SWAPPED = [BLAZEPOSE_33.index(_other_side(name)) for name in BLAZEPOSE_33]
# of the points after them 35..38 are those of the hands
MIRRORED = np.array([*_SWAPPED, _CENTRE, _RIM, 36, 35, 38, 37])


@dataclass(frozen=True, eq=False)
class Region:
    """A turned square of a picture that the network reads."""

    centre: Float[np.ndarray, "2"]
    """Pixels, in the convention of `evsplat.camera`."""
    side: float
    """Pixels."""
    angle: float = 0.0
    """Radians, clockwise on the picture: where the person's upright is turned to."""

    def to_picture(self, *, mirrored: bool) -> Float[np.ndarray, "2 3"]:
        """Affine map from the crop's pixels to the picture's."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[cos, -sin], [sin, cos]]) * (self.side / SIDE)
        if mirrored:
            turn = turn @ np.diag([-1.0, 1.0])
        return np.c_[turn, self.centre - turn @ np.full(2, SIDE / 2)]

    def turned(self, angle: float) -> "Region":
        """The square turned further, clockwise."""
        return Region(self.centre, self.side, self.angle + angle)


@dataclass(frozen=True, eq=False)
class Found:
    """The person as the network found it in one picture."""

    places: Float[np.ndarray, "33 2"]
    """Pixels of the picture; the median over copies."""
    spread: Float[np.ndarray, "33"]
    """Disagreement of the copies, pixels per axis (standard deviation)."""
    visible: Float[np.ndarray, "33"]
    """Belief that a point is in view and not hidden, 0..1."""
    world: Float[np.ndarray, "33 3"]
    """Metres from the middle of the hips, axes of the camera."""
    flag: float
    """Belief that there is a person, 0..1."""
    region: Region
    """Where it would be read next."""

    @property
    def doubt(self) -> float:
        """Disagreement of the copies about half of the limbs' joints, over the region's side.

        It tells a wrong upright, which the flag does not: a cartwheel has a flag of 1 however the
        region is turned, and one tenth of the disagreement where it is turned with the person.
        """
        return float(np.median(self.spread[list(LIMB_POINTS)])) / self.region.side

    @property
    def is_person(self) -> bool:
        """True where the network believes so and its copies agree."""
        return self.flag >= LEAST_FLAG and self.doubt <= MOST_DOUBT


def find_in(
    network: LandmarkNetwork,
    picture: Float[Tensor, "H W 3"],
    region: Region,
    *,
    copies: Sequence[tuple[float, bool]] = COPIES,
) -> Found:
    """The person in a region, from ``copies`` of it; one alone has no spread.

    Places are medians: where limbs hide each other a copy may take one for another.
    """
    turned = [(region.turned(turn), mirrored) for turn, mirrored in copies]
    crops = torch.stack([crop(picture, *copy) for copy in turned])
    output = network(crops)
    points = refined(output)
    readings = [_reading(output, points, index, *copy) for index, copy in enumerate(turned)]
    places = np.stack([reading[0] for reading in readings])
    world = np.stack([reading[1] for reading in readings])
    visible = np.stack([reading[2] for reading in readings])
    median = np.median(places, axis=0)
    rim = median[_RIM] - median[_CENTRE]
    following = Region(
        median[_CENTRE],
        max(2 * _MARGIN * float(np.hypot(*rim)), 1.0),
        float(np.arctan2(rim[0], -rim[1])),
    )
    body = slice(len(BLAZEPOSE_33))
    spread = np.sqrt(places.var(0, ddof=min(1, len(copies) - 1)).mean(-1))
    return Found(
        median[body],
        spread[body],
        visible.mean(0)[body],
        np.median(world, axis=0)[body],
        float(output.flag.mean()),
        following,
    )


def crop(
    picture: Float[Tensor, "H W 3"], region: Region, mirrored: bool
) -> Float[Tensor, "256 256 3"]:
    """The picture in a region, black beyond its border."""
    channels = picture.movedim(-1, 0)[None]
    shrink = max(1, round(region.side / SIDE))
    if shrink > 1:  # else every second pixel of a large picture would count alone
        channels = F.avg_pool2d(channels, shrink, ceil_mode=True, count_include_pad=False)
    to_picture = torch.from_numpy(region.to_picture(mirrored=mirrored)).to(picture)
    at = torch.arange(SIDE).to(picture) + 0.5
    rows, columns = torch.meshgrid(at, at, indexing="ij")
    places = torch.stack((columns, rows), -1) @ to_picture[:, :2].T + to_picture[:, 2]
    size = torch.tensor(channels.shape[:1:-1]).to(picture) * shrink
    grid = 2 * places / size - 1
    values = F.grid_sample(channels, grid[None], align_corners=False)[0].movedim(0, -1)
    return values.clamp(0, 1)


def refined(output: NetworkOutput) -> Float[np.ndarray, "B 39 2"]:
    """Points in pixels of the crop: the centre of the heat around each, where there is enough.

    Cell k of the heat map stands for pixel 4 k, not for its middle: so MediaPipe has it, and so
    plain and mirrored copies agree.
    """
    points = output.points[..., :2].double().cpu().numpy()
    heat = torch.sigmoid(output.heat).double().cpu().numpy()
    cell = SIDE / HEAT_SIDE
    index = np.floor(points / cell).astype(int)
    inside = ((index >= 0) & (index < HEAT_SIDE)).all(-1)
    steps = np.arange(-_HEAT_REACH, _HEAT_REACH + 1)
    rows = index[..., 1, None, None] + steps[:, None]
    columns = index[..., 0, None, None] + steps
    padded = np.pad(heat, ((0, 0), (0, 0), (_HEAT_REACH, _HEAT_REACH), (_HEAT_REACH, _HEAT_REACH)))
    batch, point = np.ogrid[: len(points), :POINTS]
    last = HEAT_SIDE + 2 * _HEAT_REACH - 1
    patch = padded[
        batch[..., None, None],
        point[..., None, None],
        np.clip(rows + _HEAT_REACH, 0, last),
        np.clip(columns + _HEAT_REACH, 0, last),
    ]
    total = patch.sum((-1, -2))
    clear = inside & (patch.max((-1, -2)) >= _LEAST_HEAT)
    weights = patch / np.maximum(total, 1e-9)[..., None, None]
    centre = np.stack([(weights * columns).sum((-1, -2)), (weights * rows).sum((-1, -2))], -1)
    return np.where(clear[..., None], centre * cell, points)


def _reading(
    output: NetworkOutput, points: np.ndarray, index: int, region: Region, mirrored: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places in the picture, world places along the camera's axes, visibility, of one copy."""
    to_picture = region.to_picture(mirrored=mirrored)
    places = points[index] @ to_picture[:, :2].T + to_picture[:, 2]
    logits = output.points[index, :, 3:].double().cpu()
    visible = torch.sigmoid(logits).prod(-1).numpy()
    world = output.world[index].double().cpu().numpy()
    if mirrored:
        world = world * np.array([-1.0, 1.0, 1.0])
        places, world, visible = places[MIRRORED], world[MIRRORED], visible[MIRRORED]
    cos, sin = np.cos(region.angle), np.sin(region.angle)
    return places, world @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]]), visible
