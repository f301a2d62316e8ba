"""Starts of Gaussians: on the body's surface, in a random cube, or on the median backdrop."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Camera
from evsplat.gaussians.gaussian_set import FEATURE_DIM
from evsplat.neighbours import nearest

_FEET = 500
"""One point of the body in so many lies below the floor."""
_MOST_LOW = 200_000
"""Lowest points that are kept: enough for the floor of a hundred million."""


def logit(probability: float) -> float:
    """Inverse of the sigmoid."""
    return math.log(probability / (1 - probability))


def nearest_spacing(points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Root mean squared distance to the three nearest neighbours, metres, at least 0.3 mm."""
    if len(points) < 4:
        return torch.full((len(points),), 0.05)
    return nearest(points, 3)[0].square().mean(-1).sqrt().float().clamp_min(3e-4)


def gaussians_at(
    points: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    *,
    opacity: float,
    semantic_logit: float,
    quaternions: Float[Tensor, "N 4"] | None = None,
    rgb_srgb: Float[Tensor, "N 3"] | None = None,
    feature_dim: int | None = FEATURE_DIM,
) -> dict[str, Tensor]:
    """Start values of all attributes; colours are grey where none is given.

    ``feature_dim`` inputs of a colour network, whose first three are the logits of the colour;
    None: the logits alone are the colour.
    """
    count = len(points)
    logits = torch.zeros(count, 3)
    if rgb_srgb is not None:
        logits = torch.logit(rgb_srgb.float().clamp(0.01, 0.99))
    colour = {"colour_logits": logits}
    if feature_dim is not None:
        colour = {"features": torch.nn.functional.pad(logits, (0, feature_dim - 3))}
    if quaternions is None:
        quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    return {
        "means": points.float(),
        "scales_log": scales.float().log(),
        "quaternions": quaternions.float(),
        "opacity_logits": torch.full((count,), logit(opacity)),
        **colour,
        "semantic_logits": torch.full((count,), semantic_logit),
    }


def facing(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 4"]:
    """Rotations, (w, x, y, z), that turn the third axis to the unit ``normals`` the short way."""
    x, y, z = normals.float().unbind(-1)
    # Half-way quaternion of z = (0, 0, 1) and the normal; straight down, any half turn will do.
    half = torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1)
    half[z < -0.9999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(half, dim=-1)


def random_cube(
    center: Float[Tensor, "3"], half_side: float, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Positions uniform in an axis-aligned cube, and uniform colours (HUGS in the paper, 2.9)."""
    points = center + half_side * (2 * torch.rand(count, 3, generator=generator) - 1)
    return points, torch.rand(count, 3, generator=generator)


def backdrop_depth(
    camera: Camera,
    body_points: Iterable[Float[Tensor, "M 3"]],
    *,
    up: Float[Tensor, "3"],
    margin: float,
) -> Float[Tensor, "H W"]:
    """Depth per pixel, metres, of a floor under the body and a wall behind it.

    ``body_points`` of the whole recording come in pieces, so that an hour's are never all there.

    With one static camera depth cannot be seen, and for that camera any surface that the person
    never passes will do. The wall stands ``margin`` (a fraction) behind the deepest body point,
    facing the camera; the floor is the plane through the lowest body points, orthogonal to ``up``.
    """
    deepest, floor_height = extremes(camera, body_points, up)
    wall = deepest * (1 + margin)
    rays = pixel_rays(camera)
    camera_height = camera.center() @ up
    fall = rays @ up
    # A ray meets the floor in front of the camera only where it falls.
    floor = torch.where(fall < -1e-3, (floor_height - camera_height) / fall, torch.inf)
    return torch.where(floor > 0, floor, torch.inf).clamp_max(wall)


def extremes(
    camera: Camera, pieces: Iterable[Float[Tensor, "M 3"]], up: Float[Tensor, "3"]
) -> tuple[float, float]:
    """The largest depth of all points, and the height that one in `_FEET` lies below, metres."""
    deepest, count, low = -math.inf, 0, torch.zeros(0)
    for points in pieces:
        deepest = max(deepest, float(camera.project(points)[1].max()))
        count += len(points)
        low = torch.cat([low, points @ up])
        # No more than these can be among the lowest of all that may still come.
        if len(low) > 2 * _MOST_LOW:
            low = low.topk(_MOST_LOW, largest=False).values
    place = (count - 1) / _FEET
    lowest = low.sort().values
    first = min(int(place), len(lowest) - 1)
    after = min(first + 1, len(lowest) - 1)
    return deepest, float(torch.lerp(lowest[first], lowest[after], place - int(place)))


def pixel_rays(camera: Camera) -> Float[Tensor, "H W 3"]:
    """World direction through each pixel centre, scaled to advance one metre in depth."""
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return pixels @ torch.linalg.inv(camera.K).T @ camera.world_to_camera[:3, :3]


def median_backdrop(
    camera: Camera,
    background_srgb: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    *,
    stride: int,
    edge_points: int,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Positions, scales and colours of a sheet that looks like the median of the frames.

    One Gaussian per ``stride`` x ``stride`` pixels and one on each of the ``edge_points`` pixels of
    strongest gradient, where a coarse sheet would be soft.
    """
    height, width = depth.shape
    rays, center = pixel_rays(camera), camera.center()

    pooled = torch.nn.functional.avg_pool2d(
        background_srgb.permute(2, 0, 1)[None], stride, ceil_mode=True, count_include_pad=False
    )[0].permute(1, 2, 0)
    rows = (torch.arange(pooled.shape[0]) * stride + (stride - 1) / 2).clamp_max(height - 1)
    columns = (torch.arange(pooled.shape[1]) * stride + (stride - 1) / 2).clamp_max(width - 1)
    grid_y, grid_x = torch.meshgrid(rows, columns, indexing="ij")

    gray = background_srgb.mean(-1)
    gradient = torch.hypot(*torch.gradient(gray))
    strongest = gradient.flatten().topk(min(edge_points, gradient.numel())).indices

    index = torch.cat([(grid_y.round() * width + grid_x.round()).long().flatten(), strongest])
    spacing = torch.cat([torch.full((grid_y.numel(),), float(stride)), torch.ones(len(strongest))])
    colours = torch.cat([pooled.reshape(-1, 3), background_srgb.reshape(-1, 3)[strongest]])
    chosen_depth = depth.flatten()[index]
    # Half-pixel offsets of an even stride are below what the fit that follows corrects.
    points = center + chosen_depth[:, None] * rays.reshape(-1, 3)[index]
    footprint = 0.6 * spacing * chosen_depth / camera.K[0, 0]
    return points, footprint[:, None].repeat(1, 3), colours
