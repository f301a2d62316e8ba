"""Discs that reach off the body, which would float along with it in other poses.

Training lets a few of them grow far beyond their neighbours, to paint the shadow below a shoe or
the room between the legs: right in the recorded poses, a haze around a raised foot in others.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import SurfaceSamples
from evsplat.body.rotations import quaternion_to_matrix
from evsplat.neighbours import median_around, nearest

SIGMAS = 2.0
"""Standard deviations along its axes at which a disc is taken to end."""
MOST_M = 0.04
"""How far a disc may reach beyond its neighbours' centres."""
_LEAST = 0.05
"""Of a disc's size that is left at least, where its centre alone stands farther off."""


def within_reach(
    means: Float[Tensor, "H 3"],
    quaternions: Float[Tensor, "H 4"],
    scales: Float[Tensor, "H 3"],
    surface: SurfaceSamples,
) -> Float[Tensor, " H"]:
    """Factors in 0.05..1 on the sizes with which no disc reaches farther than `MOST_M`.

    Canonical centres and sizes (standard deviations) in metres, rotations wxyz. Heights are those
    over the body's nearest point, against half of the neighbours' centres; one disc has none.
    """
    if len(means) < 2:
        return torch.ones_like(means[:, 0])
    heights = _heights(means, surface)
    usual = median_around(means, heights)
    axes = SIGMAS * quaternion_to_matrix(quaternions) * scales[:, None]
    ends = [_heights(means + way * axis, surface) for axis in axes.unbind(-1) for way in (1, -1)]
    stands, reaches = heights - usual, torch.stack(ends).amax(0) - usual
    bearable = (MOST_M - stands) / (reaches - stands).clamp_min(torch.finfo(means.dtype).tiny)
    return torch.where(reaches > MOST_M, bearable.clamp(_LEAST, 1), torch.ones_like(reaches))


def _heights(points: Float[Tensor, "N 3"], surface: SurfaceSamples) -> Float[Tensor, " N"]:
    """Over the body's nearest point along its normal, metres; negative inside."""
    index = nearest(surface.points, 1, points)[1][:, 0]
    return ((points - surface.points[index]) * surface.normals[index]).sum(-1)
