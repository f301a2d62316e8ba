"""What a spline misses between its keys is told from the keys within the factor it promises."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body
from evsplat.body.smoothing import FEWEST_SPLINE_KEYS, spline_error


@pytest.fixture(scope="module")
def body():
    return default_body()


def wander(body, seed: int, keys_per_bend: float):
    """Poses and places at any time in keys, which bend anew after so many keys."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-2, 45, keys_per_bend)
    steps = rng.normal(size=(len(knots), len(body.parents) + 1, 3)).cumsum(0)
    curve = CubicSpline(knots, 0.1 * keys_per_bend * steps)

    def at(place):
        values = curve(place)
        values[:, -4:-1] = 0.3
        return values[:, :-1], values[:, -1]

    return at


@pytest.mark.parametrize(("keys_per_bend", "most"), [(0.9, 4), (1.5, 10), (3.3, 100)])
@pytest.mark.parametrize("seed", range(2))
def test_the_error_of_fast_motion_is_told_and_that_of_slow_motion_bounded(
    body, seed, keys_per_bend, most
):
    at = wander(body, seed, keys_per_bend)
    keys = np.arange(41)
    track = BodyTrack(body, 40_000 * keys, *at(keys))
    found = spline_error(track)
    # The ends are worse; nothing is learned there that the middle does not need.
    place = np.linspace(3, 37, 341)
    poses, transl = at(place)
    turned, moved = track.at(torch.from_numpy((40_000 * place).astype(np.int64)))
    truth = Rotation.from_rotvec(poses.reshape(-1, 3))
    apart = truth.inv() * Rotation.from_matrix(turned.double().reshape(-1, 3, 3).numpy())
    angles = apart.magnitude().reshape(poses.shape[:2])
    true_rad = np.sqrt((angles**2).mean(0) / 3)
    ratio = found.rotation_rad[:-3] / true_rad[:-3]
    assert 0.5 < np.median(ratio) < most
    assert (found.rotation_rad[-3:] < 1e-6).all()
    true_m = np.sqrt(np.square(moved.numpy() - transl).mean())
    assert 0.5 < found.translation_m / true_m < most


def test_too_few_keys_tell_nothing(body):
    keys = np.arange(FEWEST_SPLINE_KEYS - 1)
    track = BodyTrack(body, 40_000 * keys, *wander(body, 0, 1.0)(keys))
    found = spline_error(track)
    assert not found.rotation_rad.any() and found.translation_m == 0
