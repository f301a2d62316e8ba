"""Silhouette and pixel box of a posed body in a camera."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from evsplat.body.track import BodyTrack
from evsplat.camera import Camera
from evsplat.compiled import native
from evsplat.pictures.box import Box

NEAR = 0.01
"""Triangles that come nearer to the camera plane than this (metres) are not drawn."""


def silhouette(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera
) -> Bool[Tensor, "H W"]:
    """Pixels whose centre lies inside a projected triangle of the mesh.

    ``vertices`` lie in the world, metres; ``faces`` are their indices. Triangles with a corner
    nearer to the camera's plane than `NEAR`, or behind it, are left out.
    """
    pixels, depth = camera.project(vertices.detach())
    places, in_front = pixels.double().cpu(), (depth > NEAR).cpu()
    if native is not None:
        filled = torch.zeros(camera.height, camera.width, dtype=torch.uint8)
        mesh = places.contiguous(), in_front.byte(), faces.cpu().long().contiguous()
        native.fill_triangles(*mesh, filled)
        return filled.bool()
    return torch.from_numpy(_filled(places.numpy(), in_front.numpy(), faces.cpu().numpy(), camera))


def track_silhouette(track: BodyTrack, time_us: int, camera: Camera) -> Bool[Tensor, "H W"]:
    """Pixels whose centre the body covers as it is posed at a time, microseconds."""
    return silhouette(track.vertices(time_us), track.body.faces, camera)


def _filled(
    places: Float[np.ndarray, "V 2"],
    in_front: Bool[np.ndarray, "V"],
    triangles: Int[np.ndarray, "F 3"],
    camera: Camera,
) -> Bool[np.ndarray, "H W"]:
    """`silhouette` without the compiled module."""
    height, width = camera.height, camera.width
    corners = places[triangles][in_front[triangles].all(1)]
    # First and one-past-last pixel whose centre (index + 0.5) can lie inside.
    size = np.array([width, height])
    first = np.clip(np.ceil(corners.min(1) - 0.5), 0, size).astype(np.int64)
    last = np.clip(np.floor(corners.max(1) - 0.5) + 1, 0, size).astype(np.int64)
    extent = (last - first).max(1)
    hit = ((last - first) > 0).all(1)
    mask = np.zeros((height, width), dtype=bool)
    # Triangles of like size are tested together on one square patch of pixels each.
    patch, smaller = 1, 0
    while smaller < max(width, height):
        group = hit & (extent > smaller) & (extent <= patch)
        for chunk in np.array_split(np.flatnonzero(group), 1 + group.sum() * patch**2 // 2_000_000):
            _fill(mask, corners[chunk], first[chunk], last[chunk], patch)
        patch, smaller = patch * 2, patch
    return mask


def body_box(vertices: Float[Tensor, "V 3"], camera: Camera, margin: float = 0.1) -> Box | None:
    """Pixels around a posed body, enlarged on each side and clipped to the picture.

    ``vertices`` lie in the world, metres; ``margin`` is a share of the box's own extent. None where
    the body is out of view.
    """
    pixels, depth = camera.project(vertices.detach())
    seen = pixels[depth > NEAR].double().cpu().numpy()
    if len(seen) == 0:
        return None
    low, high = seen.min(0), seen.max(0)
    size = np.array([camera.width, camera.height])
    start = np.clip(np.floor(low - margin * (high - low)), 0, size).astype(int)
    stop = np.clip(np.ceil(high + margin * (high - low)), 0, size).astype(int)
    if (stop <= start).any():
        return None
    return Box(int(start[1]), int(stop[1]), int(start[0]), int(stop[0]))


def _fill(
    mask: np.ndarray, corners: np.ndarray, first: np.ndarray, last: np.ndarray, patch: int
) -> None:
    """Set the pixels covered by triangles (K, 3, 2) whose boxes fit in ``patch`` pixels squared."""
    offset = np.arange(patch)
    x = first[:, 0, None] + offset
    y = first[:, 1, None] + offset
    inside_box = (x < last[:, 0, None])[:, None, :] & (y < last[:, 1, None])[:, :, None]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    sign = np.sign(_cross(b - a, c - a))[:, None, None]
    inside = inside_box & (sign != 0)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        along_y = edge[:, 0, None] * (y + 0.5 - start[:, 1, None])
        along_x = edge[:, 1, None] * (x + 0.5 - start[:, 0, None])
        inside &= sign * (along_y[:, :, None] - along_x[:, None, :]) >= 0
    triangle, row, column = np.nonzero(inside)
    mask[y[triangle, row], x[triangle, column]] = True


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
