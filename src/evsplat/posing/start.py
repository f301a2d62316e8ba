"""A first guess of the trunk at every picture: where it is and how it is turned."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.posing.rig import Rig
from evsplat.posing.views import Views

TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
"""Landmarks that a fit begins with."""


def first_trunk(
    rig: Rig,
    views: Views,
    names: Sequence[str],
    places: Float[Tensor, "T L 2"],
    world: Float[Tensor, "T L 3"] | None,
) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"]]:
    """Root rotations (world, frames of the body that ships) and places of the root joint.

    From the detector's own points in space where it gives any; else the trunk is taken as upright
    in the picture, turned by how narrow it looks and to the side where the nose is.
    """
    trunk = [list(names).index(name) for name in TRUNK]
    width, height = _trunk_size(rig)
    if world is not None:
        left, up, scale = _from_space(world[:, trunk], places[:, trunk], world, places)
    else:
        left, up, scale = _from_picture(names, places, trunk, width, height)
    up = torch.nn.functional.normalize(up - (up * left).sum(-1, keepdim=True) * left, dim=-1)
    in_camera = torch.stack((left, torch.linalg.cross(up, left), up), -1)
    hips = (places[:, trunk[2]] + places[:, trunk[3]]) / 2
    depth = views.focal_px.mean() / scale
    return views.rotation.mT @ in_camera, views.lift(hips, depth.expand(len(hips)))


def _from_space(
    trunk: Float[Tensor, "T 4 3"],
    trunk_places: Float[Tensor, "T 4 2"],
    world: Float[Tensor, "T L 3"],
    places: Float[Tensor, "T L 2"],
) -> tuple[Tensor, Tensor, Tensor]:
    left = torch.nn.functional.normalize(trunk[:, 2] - trunk[:, 3], dim=-1)
    up = trunk[:, :2].mean(1) - trunk[:, 2:].mean(1)
    flat = world[..., :2] - trunk[:, None, 2:, :2].mean(2)
    seen = places - trunk_places[:, 2:].mean(1, keepdim=True)
    pixels_per_metre = (flat * seen).sum((1, 2)) / (flat * flat).sum((1, 2))
    return left, up, pixels_per_metre.median()


def _from_picture(
    names: Sequence[str],
    places: Float[Tensor, "T L 2"],
    trunk: list[int],
    width: float,
    height: float,
) -> tuple[Tensor, Tensor, Tensor]:
    corners = places[:, trunk]
    rise = corners[:, :2].mean(1) - corners[:, 2:].mean(1)
    # A trunk is hardly ever longer than it is: the longest views show it unforeshortened.
    scale = rise.norm(dim=-1).quantile(0.8) / height
    up = torch.nn.functional.normalize(rise, dim=-1)
    right = torch.stack((-up[:, 1], up[:, 0]), -1)
    across = (corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]) / 2
    cosine = ((across * right).sum(-1) / (scale * width)).clamp(-1, 1)
    side = torch.ones_like(cosine)
    if "nose" in names:
        nose = places[:, list(names).index("nose")] - corners[:, :2].mean(1)
        side = torch.where((nose * right).sum(-1) >= 0, side, -side)
    sine = side * (1 - cosine**2).sqrt()
    zero = torch.zeros_like(cosine)[:, None]
    left = torch.cat((cosine[:, None] * right, sine[:, None]), -1)
    return left, torch.cat((up, zero), -1), scale


def _trunk_size(rig: Rig) -> tuple[float, float]:
    """Mean of the distances between shoulders and between hips, and from hips to shoulders."""
    part = {name: rig.rest[rig.joint(name)] for name in
            ("left_upper_arm", "right_upper_arm", "left_thigh", "right_thigh")}  # fmt: skip
    shoulders = part["left_upper_arm"], part["right_upper_arm"]
    hips = part["left_thigh"], part["right_thigh"]
    width = ((shoulders[0] - shoulders[1]).norm() + (hips[0] - hips[1]).norm()) / 2
    height = ((shoulders[0] + shoulders[1]) / 2 - (hips[0] + hips[1]) / 2).norm()
    return float(width), float(height)
