"""How far away the scene is at each pixel, where frames of a moving camera tell it: a plane sweep.

Frames are carried onto surfaces nearer and farther than a given one (Collins, A Space-Sweep
Approach to True Multi-Image Matching, CVPR 1996). Where they agree, there the scene is; where no
texture tells, it is as far as what lies beside it (Hirschmueller, Stereo Processing by Semiglobal
Matching and Mutual Information, PAMI 2008).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.ndimage import median_filter
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays

MOST_PIXELS, MOST_SURFACES = 32_768, 64
"""That are compared."""
NEAREST, FARTHEST = 2.5, 0.5
"""Inverse distances that are tried, as shares of the given surface's."""
LEAST_PARALLAX_PX = 2.0
"""By which some frame must see half the distance displaced from the whole."""
_DIFFERENT = 0.12
"""Difference of colour, [0, 1], above which all count alike: what is hidden, or in a shadow."""
_WHOLE = 0.99
"""Share of a pixel by which the scene must be seen there."""
_FEW, _ENOUGH = 0.2, 0.4
"""Shares of the frames that tell nothing, and all; two and five at least."""
_NEAR = 0.75, 1.5
"""Inverse distances at which they must show the scene."""
_WINDOW = 5
"""Side of the square of pixels that are compared at once."""
_BENT, _BROKEN = 0.006, 0.03
"""Prices of a neighbour on the next surface, and on any other."""
_ELSEWHERE = 0.002
"""Price of any surface but the given one."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of the scene."""

    camera: Camera
    picture: Float[Tensor, "h w 3"]
    """In [0, 1]."""
    free: Float[Tensor, "h w"]
    """1 where the scene is seen, 0 where the person may be."""


def depth_shares(
    view: Camera, depth: Float[Tensor, "H W"], shots: Iterable[Shot]
) -> Float[Tensor, "H W"]:
    """Depth of the scene at the pixels of ``view`` as a share of ``depth``, metres.

    All ones where the frames hardly differ in place.
    """
    step = max(1, math.ceil(math.sqrt(view.width * view.height / MOST_PIXELS)))
    shots = [_smaller(shot, step) for shot in shots]
    coarse = view.smaller(step, whole=False)
    given = pooled(depth[..., None], step)[..., 0]
    parallax = _parallax_px(coarse, given, shots)
    if parallax < LEAST_PARALLAX_PX:
        return torch.ones_like(depth)
    count = min(MOST_SURFACES, math.ceil((NEAREST - FARTHEST) * parallax) + 1)
    inverse = torch.linspace(FARTHEST, NEAREST, count)
    # One of them is the given surface itself.
    inverse = inverse + (1 - inverse[(inverse - 1).abs().argmin()])
    carried = [_Carried.of(shot, coarse, given) for shot in shots]
    compared = [_disagreement([each.to(float(one)) for each in carried]) for one in inverse]
    costs, shown = (torch.stack([each[part] for each in compared]) for part in (0, 1))
    near = (inverse > _NEAR[0]) & (inverse < _NEAR[1])
    # Where the person hides some of the surfaces, others win by what is not seen of them.
    costs *= _telling(shown[near].amin(0), len(shots))
    costs += _ELSEWHERE * (inverse != 1)[:, None, None]
    chosen = torch.from_numpy(median_filter(_smooth(costs).numpy(), _WINDOW, mode="nearest"))
    shares = 1 / (inverse[chosen] + (inverse[1] - inverse[0]) * _between(costs, chosen))
    return enlarged(shares, step)[: view.height, : view.width]


def _parallax_px(view: Camera, depth: Float[Tensor, "H W"], shots: Sequence[Shot]) -> float:
    """By how much the frame that sees it most displaced sees half the depth elsewhere, pixels."""
    rays, center = pixel_rays(view), view.center()
    most = 0.0
    for shot in shots:
        far, ahead = shot.camera.project(center + depth[..., None] * rays)
        near, before = shot.camera.project(center + 0.5 * depth[..., None] * rays)
        both = (ahead > 0) & (before > 0)
        if both.any():
            most = max(most, float((far - near)[both].norm(dim=-1).median()))
    return most


def _telling(shown: Float[Tensor, "H W"], count: int) -> Float[Tensor, "H W"]:
    """How far so many frames out of all are believed."""
    few, enough = max(2.0, _FEW * count), max(5.0, _ENOUGH * count)
    return ((shown - few) / (enough - few)).clamp(0, 1)


def _disagreement(
    seen: Sequence[Float[Tensor, "4 H W"]],
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Mean difference of the frames from their mean, in windows, and how many show the surface."""
    colours = torch.stack([each[:3] for each in seen])
    shows = torch.stack([each[3] for each in seen])[:, None] > _WHOLE
    total = shows.sum(0)
    mean = (shows * colours).sum(0) / total.clamp_min(1)
    apart = (colours - mean).abs_().mean(1, keepdim=True).clamp_max_(_DIFFERENT)
    # Of a few frames the mean is nearer to each.
    cost = ((shows * apart).sum(0) / (total - 1).clamp_min(1)).clamp_max(_DIFFERENT)
    cost = torch.where(total > 2, cost, _DIFFERENT)
    return avg_pool2d(cost, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)[0], total[0]


@dataclass(frozen=True, eq=False)
class _Carried:
    """A frame, to be looked up from a view at surfaces whose depth is a share of a given one's."""

    values: Float[Tensor, "1 4 h w"]
    """Picture, and where the scene is seen."""
    given: Float[Tensor, "H W 3"]
    """Of places on the given surface, as if the frame's camera stood where the view's does:
    homogeneous pixels, from -1 to 1 over the frame."""
    aside: Float[Tensor, "3"]
    """What the frame's camera adds where it stands, at the given depth; in proportion nearer by."""

    @staticmethod
    def of(shot: Shot, view: Camera, depth: Float[Tensor, "H W"]) -> "_Carried":
        """From the pixels of ``view``, the given surface being at ``depth``."""
        camera, pose = shot.camera, shot.camera.world_to_camera
        x, y = 2 / camera.width, 2 / camera.height
        over = torch.tensor([[x, 0.0, -1.0], [0.0, y, -1.0], [0.0, 0.0, 1.0]]) @ camera.K
        rays = depth[..., None] * pixel_rays(view)
        aside = pose[:3, :3] @ view.center() + pose[:3, 3]
        values = torch.cat([shot.picture, shot.free[..., None]], -1).movedim(-1, 0)[None]
        return _Carried(values, rays @ (over @ pose[:3, :3]).T, over @ aside)

    def to(self, inverse: float) -> Float[Tensor, "4 H W"]:
        """Its values at an inverse depth, as a share of the given surface's; 0 out of view."""
        x, y, z = (self.given + inverse * self.aside).unbind(-1)
        ahead = z > 0
        places = torch.stack([torch.where(ahead, each / z, -2.0) for each in (x, y)], -1)
        return grid_sample(self.values, places[None], align_corners=False)[0]


def _smooth(costs: Float[Tensor, "N H W"]) -> Int[Tensor, "H W"]:
    """The cheapest surface at each pixel, neighbours on another one costing something."""
    total = torch.zeros_like(costs)
    for axis in (1, 2):
        lines = costs.movedim(axis, 0)
        along = _along(lines)
        back = _along(lines.flip(0)).flip(0)
        total += (along + back).movedim(0, axis)
    return total.argmin(0)


def _between(costs: Float[Tensor, "N H W"], chosen: Int[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Where between surfaces the parabola through the costs about the chosen ones is lowest."""
    inner = chosen.clamp(1, len(costs) - 2)
    before, there, after = (costs.gather(0, (inner + side)[None])[0] for side in (-1, 0, 1))
    bend = before - 2 * there + after
    lowest = 0.5 * (before - after) / bend.clamp_min(1e-9)
    return torch.where((bend > 0) & (inner == chosen), lowest.clamp(-0.5, 0.5), 0.0)


def _along(lines: Float[Tensor, "L N M"]) -> Float[Tensor, "L N M"]:
    """Costs of the best way to each line from the first one."""
    found = [lines[0]]
    for line in lines[1:]:
        before = found[-1]
        least = before.amin(0)
        beside = torch.full_like(before, torch.inf)
        beside[1:] = before[:-1]
        beside[:-1] = torch.minimum(beside[:-1], before[1:])
        way = torch.minimum(torch.minimum(before, beside + _BENT), least + _BROKEN)
        found.append(line + way - least)
    return torch.stack(found)


def _smaller(shot: Shot, step: int) -> Shot:
    free = pooled(shot.free[..., None], step)[..., 0]
    return Shot(shot.camera.smaller(step, whole=False), pooled(shot.picture, step), free)


def pooled(values: Float[Tensor, "H W C"], step: int) -> Float[Tensor, "h w C"]:
    """Means of squares of ``step`` pixels, smaller ones at the right and at the bottom."""
    means = avg_pool2d(values.movedim(-1, 0)[None], step, ceil_mode=True, count_include_pad=False)
    return means[0].movedim(0, -1)


def enlarged(values: Float[Tensor, "h w"], step: int) -> Float[Tensor, "H W"]:
    """Each value in a square of ``step`` pixels."""
    return values.repeat_interleave(step, 0).repeat_interleave(step, 1)
