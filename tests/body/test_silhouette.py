"""Triangle fill against a point-in-triangle test of every pixel, and the body's pixel box."""

import sys

import numpy as np
import pytest
import torch

from evsplat.body import body_box, default_body, silhouette
from evsplat.camera import Camera
from evsplat.pictures.box import Box


def camera(width=48, height=37, focal=40.0, distance=3.0):
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    world_to_camera = torch.eye(4)
    world_to_camera[2, 3] = distance
    return Camera(width, height, K, world_to_camera)


def reference(vertices, faces, view):
    """Barycentric coordinates of every pixel centre in every triangle."""
    pixels, depth = view.project(vertices.double())
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    mask = np.zeros((view.height, view.width), bool)
    for face in faces.tolist():
        if (depth[face] <= 0.01).any():
            continue
        (ax, ay), (bx, by), (cx, cy) = pixels[face].numpy()
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
        mask |= (u >= 0) & (v >= 0) & (u + v <= 1)
    return mask


@pytest.mark.parametrize("seed", range(5))
def test_fill_equals_a_test_of_every_pixel_for_tiny_huge_and_clipped_triangles(seed):
    generator = torch.Generator().manual_seed(seed)
    vertices = 2.5 * torch.randn(60, 3, generator=generator)
    sizes = torch.rand(20, 1, 1, generator=generator) ** 3 * 3
    corners = torch.randn(20, 1, 3, generator=generator) + sizes * torch.randn(
        20, 3, 3, generator=generator
    )
    vertices = corners.reshape(-1, 3)
    faces = torch.arange(60).view(20, 3)
    mask = silhouette(vertices, faces, camera()).numpy()
    expected = reference(vertices, faces, camera())
    assert mask.any() and (mask == expected).all()


@pytest.mark.parametrize("seed", range(3))
def test_without_the_compiled_module_the_same_pixels_are_filled(seed, monkeypatch):
    generator = torch.Generator().manual_seed(seed)
    corners = torch.randn(200, 1, 3, generator=generator)
    corners = corners + torch.rand(200, 1, 1) * torch.randn(200, 3, 3, generator=generator)
    vertices, faces = corners.reshape(-1, 3), torch.arange(600).view(200, 3)
    vertices[5] = torch.nan
    vertices[9, 0] = 1e30
    mask = silhouette(vertices, faces, camera())
    monkeypatch.setattr(sys.modules[silhouette.__module__], "native", None)
    assert mask.any() and torch.equal(mask, silhouette(vertices, faces, camera()))


def test_a_body_far_away_and_a_body_behind():
    body = default_body()
    upright = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    vertices = body.canonical_vertices() @ upright.T
    mask = silhouette(vertices, body.faces, camera(64, 64, 90.0))
    rows, columns = torch.nonzero(mask).T
    box = body_box(vertices, camera(64, 64, 90.0), margin=0.0)
    # The box holds the silhouette, tight to a pixel.
    assert 0 <= columns.min() - box.left <= 1 and 0 <= box.right - 1 - columns.max() <= 1
    assert 0 <= rows.min() - box.top <= 1 and 0 <= box.bottom - 1 - rows.max() <= 1
    behind = camera(64, 64, 90.0, distance=-3.0)
    assert not silhouette(vertices, body.faces, behind).any()
    assert body_box(vertices, behind) is None
    beside = camera(64, 64, 90.0)
    assert body_box(vertices + torch.tensor([30.0, 0, 0]), beside) is None


def test_the_box_grows_by_its_margin_and_is_clipped():
    vertices = torch.tensor([[-0.5, -0.25, 0.0], [0.5, 0.25, 0.0]])
    view = camera(100, 50, focal=60.0, distance=1.5)  # 40 x 20 pixels
    assert body_box(vertices, view, margin=0.0) == Box(15, 35, 30, 70)
    assert body_box(vertices, view, margin=0.1) == Box(13, 37, 26, 74)
    assert body_box(vertices, view, margin=2.0) == Box(0, 50, 0, 100)
