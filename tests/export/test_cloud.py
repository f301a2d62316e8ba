"""Gaussians of a picture and Gaussians of a file are the same Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.capture import Camera
from evsplat.errors import DataError
from evsplat.export.cloud import cloud_of, joined
from evsplat.render import Splats, render

from .clouds import covariances, random_cloud, random_splats

SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])


@SEEDS
def test_sheared_gaussians_keep_their_covariance(seed):
    splats = random_splats(np.random.default_rng(seed), 200)
    for time in range(2):
        cloud = cloud_of(splats, time)
        linear = splats.linear[time].double().numpy()
        want = (
            linear
            @ covariances(splats.quaternions.double().numpy(), splats.scales.numpy())
            @ linear.transpose(0, 2, 1)
        )
        got = covariances(cloud.quaternions, cloud.scales)
        # float32 keeps the values; entries that cancel are as exact as the largest of a matrix.
        size = np.abs(want).max((1, 2), keepdims=True)
        np.testing.assert_allclose(got / size, want / size, atol=2e-6)
        np.testing.assert_array_equal(cloud.means, splats.means[time].numpy())
        assert (cloud.quaternions[:, 0] >= 0).all()


@SEEDS
def test_a_file_draws_like_the_model(seed):
    """The rasteriser sees no difference between L R S and what a file can hold."""
    splats = random_splats(np.random.default_rng(seed), 300, times=1)
    splats = replace(splats, means=0.4 * splats.means + torch.tensor([0.0, 0.0, 4.0]))
    cloud = cloud_of(splats)
    channels = np.concatenate([cloud.rgb, cloud.semantic[:, None]], axis=1)
    plain = Splats(
        *(torch.from_numpy(v)[None] for v in (cloud.means, cloud.quaternions, cloud.scales)),
        torch.from_numpy(cloud.opacities)[None],
        torch.from_numpy(channels)[None],
    )
    K = torch.tensor([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    camera = Camera(64, 48, K, torch.eye(4))
    want, got = render(splats, camera), render(plain, camera)
    assert float(want.alpha.max()) > 0.5
    torch.testing.assert_close(got.image, want.image, atol=1e-4, rtol=0)


@SEEDS
def test_turned_axes_turn_covariances_and_centres(seed):
    rng = np.random.default_rng(seed)
    cloud = random_cloud(rng, 50)
    turn = Rotation.random(rng=rng).as_matrix()
    turned = cloud.rotated(turn)
    np.testing.assert_allclose(turned.means, cloud.means @ turn.T, atol=1e-5)
    want = turn @ covariances(cloud.quaternions, cloud.scales) @ turn.T
    got = covariances(turned.quaternions, turned.scales)
    np.testing.assert_allclose(got, want, atol=2e-6)
    np.testing.assert_array_equal(turned.rgb, cloud.rgb)


def test_gaussians_that_are_not_drawn_are_left_out():
    splats = random_splats(np.random.default_rng(5), 10)
    splats.means[1, 3, 0] = torch.nan
    splats.linear[1, 4] = torch.inf
    splats.linear[1, 5] = 0
    assert len(cloud_of(splats, 0)) == 10
    left = cloud_of(splats, 1)
    kept = [row for row in range(10) if row not in (3, 4, 5)]
    np.testing.assert_array_equal(left.means, splats.means[1, kept].numpy())
    assert len(joined([left, cloud_of(splats, 0)])) == 17


def test_other_channels_are_refused():
    splats = random_splats(np.random.default_rng(5), 10)
    with pytest.raises(DataError, match="5 channels"):
        cloud_of(replace(splats, channels=torch.zeros(2, 10, 5)))
