"""Cameras of the browser against closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.capture import Camera
from evsplat.view.camera import BrowserCamera, forward, letterboxed, vertical_fov


def _random_view(rng):
    x, y, z, w = Rotation.random(rng=rng).as_quat()
    return BrowserCamera((w, x, y, z), tuple(rng.normal(size=3)), rng.uniform(0.3, 1.5))


@pytest.mark.parametrize("seed", range(5))
def test_browser_camera_projects_as_its_angles_say(seed):
    """A point at angles (a, b) right of and below the optical axis, by trigonometry alone."""
    rng = np.random.default_rng(seed)
    view = _random_view(rng)
    width, height = int(rng.integers(50, 900)), int(rng.integers(50, 900))
    camera = view.sized(width, height)
    w, x, y, z = view.wxyz
    right, down, ahead = Rotation.from_quat([x, y, z, w]).as_matrix().T
    a, b, depth = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(0.5, 9)
    direction = ahead + math.tan(a) * right + math.tan(b) * down
    point = np.asarray(view.position) + depth * direction
    pixel, z = camera.project(torch.from_numpy(point).float())
    half = math.tan(view.fov / 2)
    expected = [
        width / 2 + height / 2 * math.tan(a) / half,
        height / 2 * (1 + math.tan(b) / half),
    ]
    assert pixel.numpy() == pytest.approx(expected, abs=1e-2)
    assert float(z) == pytest.approx(depth, rel=1e-4)
    assert forward(camera) == pytest.approx(ahead, abs=1e-6)
    assert camera.center().numpy() == pytest.approx(view.position, abs=1e-5)
    assert vertical_fov(camera) == pytest.approx(view.fov)


def test_the_upper_border_of_the_picture_is_half_the_field_of_view_up():
    camera = BrowserCamera((1, 0, 0, 0), (0, 0, 0), math.pi / 2).sized(640, 480)
    pixel, _ = camera.project(torch.tensor([0.0, -1.0, 1.0]))
    assert pixel.tolist() == pytest.approx([320, 0])


@pytest.mark.parametrize("size", [(300, 800), (800, 300), (501, 377), (64, 48)])
def test_a_letterboxed_camera_shows_its_whole_picture_centred(size):
    K = torch.tensor([[310.0, 0, 120.0], [0, 290.0, 101.0], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.2, -0.1, 0.4])
    camera = Camera(256, 192, K, pose)
    view, box = letterboxed(camera, *size)
    assert (view.width, view.height) == size
    assert box.width / box.height == pytest.approx(256 / 192)
    assert (box.left + box.width / 2, box.top + box.height / 2) == (size[0] / 2, size[1] / 2)
    assert min(box.left, box.top) == 0
    points = torch.tensor([[0.3, 0.2, 3.0], [-1.0, 0.5, 4.0], [0.0, 0.0, 2.0]])
    original, _ = camera.project(points)
    shown, _ = view.project(points)
    scale = box.width / 256
    expected = original * scale + torch.tensor([box.left, box.top])
    assert torch.allclose(shown, expected, atol=1e-3)
