"""A renderer with another low-pass shows what ours shows, from the recording's camera."""

from dataclasses import replace

import numpy as np
import torch

from evsplat.capture import Camera
from evsplat.export.low_pass import LEAST_VARIANCE_SHARE, for_viewer
from evsplat.render.reference import project

from .clouds import random_cloud

OWN, VIEWER = 0.1, 0.3


def _camera() -> Camera:
    K = torch.tensor([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    pose[:3, 3] = torch.tensor([0.1, -0.2, 4.0])
    return Camera(64, 48, K, pose)


def _cloud(scale_m: tuple[float, float]):
    rng = np.random.default_rng(0)
    cloud = random_cloud(rng, 200)
    scales = np.float32(rng.uniform(*scale_m, size=(200, 3)))
    return replace(cloud, means=0.1 * cloud.means, scales=scales)


def _in_picture(cloud, low_pass: float) -> np.ndarray:
    values = (torch.from_numpy(v).double() for v in (cloud.means, cloud.quaternions, cloud.scales))
    _, covariance, _ = project(*values, None, _camera(), low_pass)
    return covariance.numpy()


def test_wide_gaussians_have_the_same_covariance_in_the_picture():
    """Wider than the floor asks: what is added elsewhere is taken out, and nothing else changes."""
    cloud = _cloud((0.1, 0.3))
    changed = for_viewer(cloud, _camera(), OWN, VIEWER)
    np.testing.assert_allclose(
        _in_picture(changed, VIEWER), _in_picture(cloud, OWN), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(changed.opacities, cloud.opacities, rtol=1e-6)
    np.testing.assert_array_equal(changed.means, cloud.means)


def test_thin_gaussians_stay_solid_and_lose_opacity_for_area():
    cloud = _cloud((0.0005, 0.02))
    changed = for_viewer(cloud, _camera(), OWN, VIEWER)
    bare = 1e-9
    before, after = _in_picture(cloud, bare), _in_picture(changed, bare)
    left = np.linalg.eigvalsh(np.linalg.solve(before, after))
    assert left.min() > LEAST_VARIANCE_SHARE - 1e-3
    gained = np.linalg.det(_in_picture(changed, VIEWER)) / np.linalg.det(_in_picture(cloud, OWN))
    np.testing.assert_allclose(
        changed.opacities.astype(np.float64) ** 2 * gained,
        cloud.opacities.astype(np.float64) ** 2,
        rtol=1e-3,
    )


def test_nothing_changes_for_a_viewer_with_our_own_low_pass_or_behind_the_camera():
    cloud = _cloud((0.001, 0.3))
    assert for_viewer(cloud, _camera(), OWN, OWN) is cloud
    pose = _camera().world_to_camera.double().numpy()
    behind = replace(
        cloud, means=np.float32((cloud.means - [0, 0, 9] - pose[:3, 3]) @ pose[:3, :3])
    )
    changed = for_viewer(behind, _camera(), OWN, VIEWER)
    np.testing.assert_array_equal(changed.scales, behind.scales)
    np.testing.assert_array_equal(changed.opacities, behind.opacities)
