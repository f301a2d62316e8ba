"""What lamps see of points: places on a plane, and round Gaussians on its grid, with gradients.

In plain torch, on any device and in any precision.
"""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.devices import constant

REACH_M = 1.5
"""Half side of the square around the body, across the light, outside of which nothing is shaded."""
CELLS = 49
_NEAREST_M = 0.1


@cache
def evenly(count: int) -> tuple[float, ...]:
    """So many values from ``-REACH_M`` to `REACH_M`."""
    return tuple(REACH_M * (2 * k / (count - 1) - 1) for k in range(count))


@dataclass(frozen=True, eq=False)
class Seen:
    """Points on the plane through the body's middle that faces a lamp: the body's P, then places.

    Together, since each operation on both is one launch of a GPU.
    """

    rays: Float[Tensor, "L T P+N 3"]
    """From the lamp, world axes."""
    along: Float[Tensor, "L T P+N"]
    """The light, from the lamp."""
    spread: Float[Tensor, "L T P+N"]
    """Of the plane by what lies in front of it."""
    at: Float[Tensor, "L T P+N 2"]
    behind: Float[Tensor, "L T P+N"]
    """How far behind the plane, metres."""
    cast: Float[Tensor, "L T P 2"]
    """Where the body's own are."""


@dataclass(frozen=True, eq=False)
class Views:
    """The lamps' axes: two across the light (`_across`), and along it towards the body's middle."""

    lamps: Float[Tensor, "L 3"]
    frames: Float[Tensor, "L T 3 3"]
    twist: Float[Tensor, "L T 3"]
    """By how much the axes turn about the light as that turns."""
    distance: Float[Tensor, "L T 1"]
    count: int
    """Points of the body."""

    @classmethod
    def of(cls, lamps: Float[Tensor, "L 3"], body: Float[Tensor, "T P 3"]) -> "Views":
        """Of lamps at world places that look at the middles of bodies, metres."""
        ray = body.mean(1) - lamps[:, None]
        distance = ray.norm(dim=-1, keepdim=True)
        axis = ray / distance
        across, twist = _across(axis)
        frames = torch.cat([across, axis[..., None, :]], -2)
        return cls(lamps, frames, twist, distance, body.shape[1])

    def project(self, body: Float[Tensor, "T P 3"], places: Float[Tensor, "T N 3"]) -> Seen:
        """World points of the bodies, and places."""
        rays = torch.cat([body, places], 1) - self.lamps[:, None, None]
        local = rays @ self.frames.mT
        along = local[..., 2]
        spread = self.distance / along.clamp_min(_NEAREST_M)
        at = local[..., :2] * spread[..., None]
        return Seen(rays, along, spread, at, along - self.distance, at[:, :, : self.count])

    def backward(
        self,
        seen: Seen,
        by_at: Float[Tensor, "L T P+N 2"],
        by_behind: Float[Tensor, "L T P+N"],
    ) -> tuple[Float[Tensor, "L 3"], Float[Tensor, "T P 3"], Float[Tensor, "T N 3"]]:
        """Gradients of lamps, body and places from those of what `project` gave."""
        reach = (by_at * seen.at).sum(-1) / self.distance
        nears = torch.ops.aten.threshold_backward(seen.spread, seen.along, _NEAREST_M)
        by_along = torch.addcmul(by_behind, reach, nears, value=-1)
        by_distance = (reach - by_behind).sum(-1, keepdim=True)
        by_local = torch.cat([by_at * seen.spread[..., None], by_along[..., None]], -1)
        by_rays = by_local @ self.frames
        by_ray = self._by_ray(by_local.mT @ seen.rays, by_distance)
        by_points = by_rays.sum(0)
        by_lamps = -by_ray.sum(1) - by_rays.sum((1, 2))
        middle = by_ray.sum(0)[:, None]
        by_body = torch.add(by_points[:, : self.count], middle, alpha=1 / self.count)
        return by_lamps, by_body, by_points[:, self.count :]

    def _by_ray(
        self, by_frame: Float[Tensor, "L T 3 3"], by_distance: Float[Tensor, "L T 1"]
    ) -> Float[Tensor, "L T 3"]:
        """Gradient of the way from the lamp to the body's middle."""
        axis = self.frames[..., 2, :]
        turned = by_frame @ self.frames.mT
        about = turned[..., 0, 1] - turned[..., 1, 0]
        across = turned[..., :2, 2:].mT @ self.frames[..., :2, :]
        by_axis = by_frame[..., 2, :] - across[..., 0, :]
        by_axis = torch.addcmul(by_axis, about[..., None], self.twist)
        # Only what turns the axis, and what makes the ray longer.
        along = (by_axis * axis).sum(-1, keepdim=True)
        turning = torch.addcmul(by_axis, along, axis, value=-1) / self.distance
        return torch.addcmul(turning, by_distance, axis)


@dataclass(frozen=True, eq=False)
class Bells:
    """Round Gaussians at points of the plane, one factor per axis, at the cells of the grid."""

    widths: Float[Tensor, "L #T 1 1"]
    away: Float[Tensor, "2 L T C P"]
    """Of the cells from the points, in widths."""
    values: Float[Tensor, "2 L T C P"]

    @classmethod
    def at(cls, at: Float[Tensor, "L T P 2"], widths: Float[Tensor, "L #T"]) -> "Bells":
        """Of standard deviations ``widths``, metres, around places on the plane."""
        wide = widths[..., None, None]
        cells = constant(evenly(CELLS), at)[:, None]
        away = (cells - at.movedim(-1, 0)[..., None, :]) / wide
        return cls(wide, away, torch.exp(-0.5 * away.square()))

    def backward(
        self, by_across: Float[Tensor, "L T C P"], by_down: Float[Tensor, "L T C P"]
    ) -> tuple[Float[Tensor, "L T P 2"], Float[Tensor, "L T"]]:
        """Gradients of the points, and of the widths at each time."""
        slopes = torch.stack([by_across, by_down]) * self.values * self.away / self.widths
        return slopes.sum(-2).movedim(0, -1), (slopes * self.away).sum((0, 3, 4))


def _across(axis: Float[Tensor, "*T 3"]) -> tuple[Float[Tensor, "*T 2 3"], Float[Tensor, "*T 3"]]:
    """Two unit vectors at right angles to ``axis`` and each other (Duff et al. 2017, JCGT 6).

    They are the first rows of the reflection that takes the axis to the z axis or its opposite: as
    seen in a mirror on one side, which a shadow does not tell. And their twist: how far the first
    one moves along the second for a small move of the axis is the product with it.
    """
    sign = torch.copysign(constant((1.0,), axis), axis[..., 2:])
    between = torch.addcmul(axis, sign, constant((0.0, 0.0, 1.0), axis))
    ratio = sign * between[..., :2] / between[..., 2:]
    identity = constant(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), axis)
    rows = torch.addcmul(identity, ratio[..., None], between[..., None, :], value=-1)
    return rows, ratio @ constant(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0)), axis)
