"""Larger pictures show Gaussians as wide, in metres, as the recorded ones did."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.camera import Camera
from evsplat.models.smoothing import widened
from evsplat.render import Splats
from evsplat.render.reference import project

LOW_PASS = 0.1


@pytest.fixture
def rng(request):
    return np.random.default_rng(request.config.getoption("--seed"))


def _camera(at: tuple[float, float, float] = (0, 0, 0), focal: float = 60.0) -> Camera:
    """Looks along z from a place."""
    K = torch.tensor([[focal, 0, 32], [0, focal, 24], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, 3] = -torch.tensor(at)
    return Camera(64, 48, K, pose)


def _layer(rng: np.random.Generator, means: np.ndarray) -> Splats:
    def drawn(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(0.002, 1, shape))

    count = len(means)
    return Splats(
        torch.from_numpy(means)[None],
        drawn(1, count, 4),
        0.05 * drawn(1, count, 3),
        drawn(1, count),
        drawn(1, count, 3),
    )


def _covariances(layer: Splats, camera: Camera) -> torch.Tensor:
    _, covariance, _ = project(
        layer.means[0], layer.quaternions[0], layer.scales[0], None, camera, LOW_PASS
    )
    return covariance


@pytest.mark.parametrize("factor", [1.5, 3, 10])
def test_a_picture_so_many_times_larger_shows_the_recorded_one_enlarged(rng, factor):
    """On the axis, where a sphere is a disc: covariances grow with the square of the size."""
    layer = _layer(rng, np.array([[0, 0, z] for z in rng.uniform(0.5, 9, 30)]))
    recorder = _camera()
    larger = recorder.resized(round(64 * factor), round(48 * factor))
    shown = widened(layer, LOW_PASS, larger, [recorder])
    torch.testing.assert_close(
        _covariances(shown, larger), factor**2 * _covariances(layer, recorder), rtol=1e-5, atol=0
    )


def test_so_does_one_from_nearer_by_as_much_as_each_gaussian_is_nearer(rng):
    depths = rng.uniform(3, 9, 30)
    layer = _layer(rng, np.array([[0, 0, z] for z in depths]))
    recorder, nearer = _camera(), _camera((0, 0, 2))
    shown = widened(layer, LOW_PASS, nearer, [recorder])
    factors = torch.from_numpy(depths / (depths - 2))[:, None, None]
    torch.testing.assert_close(
        _covariances(shown, nearer), factors**2 * _covariances(layer, recorder), rtol=1e-5, atol=0
    )


@pytest.mark.parametrize("other", [_camera(), _camera(focal=30.0), _camera((0, 0, -1))])
def test_pixels_as_large_as_recorded_or_larger_change_nothing(rng, other):
    layer = _layer(rng, rng.uniform([-3, -3, 0.1], [3, 3, 9], (50, 3)))
    assert torch.equal(widened(layer, LOW_PASS, other, [_camera()]).scales, layer.scales)


def test_of_several_recorders_the_finest_one_in_whose_picture_a_gaussian_is_counts(rng):
    """Else any that it is before; one that is before none stays."""
    far, near = _camera((0, 0, -8)), _camera((5, 0, 0))
    layer = _layer(rng, np.array([[5.0, 0, 2], [0.0, 0, 2], [9.0, 9, 1], [0.0, 0, -9]]))
    close_up = replace(_camera(), K=torch.tensor([[6e6, 0, 32], [0, 6e6, 24], [0, 0, 1]]))
    shown = widened(layer, LOW_PASS, close_up, [far, near])
    added = shown.scales.square() - layer.scales.square()
    # Before the first two of both; the last two are in no picture.
    wanted = LOW_PASS * (torch.tensor([2.0, 10, 1, 0], dtype=torch.float64) / 60) ** 2
    torch.testing.assert_close(added[0], wanted[:, None].expand(-1, 3), rtol=1e-4, atol=1e-10)


def test_the_scales_of_one_time_serve_centres_at_several(rng):
    layer = _layer(rng, rng.uniform([-1, -1, 2], [1, 1, 9], (20, 3)))
    moved = replace(layer, means=torch.cat([layer.means, layer.means + torch.tensor([0, 0, 1.0])]))
    recorder = _camera()
    larger = recorder.resized(256, 192)
    shown = widened(moved, LOW_PASS, larger, [recorder])
    for time in range(2):
        one = widened(replace(moved, means=moved.means[time][None]), LOW_PASS, larger, [recorder])
        torch.testing.assert_close(shown.scales[time], one.scales[0])
