"""What a spline misses between its keys is told from the keys within the factor it promises, and
apart from the errors of those keys."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.body.spline_error import (
    _CARRIED,
    _ERROR_RATIO,
    FEWEST_SPLINE_KEYS,
    apart_from_errors,
    spline_error,
)


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


def still(body, seed: int, keys: int, joint_rad, root_m: float) -> BodyTrack:
    """A body at rest whose keys err anew each time."""
    rng = np.random.default_rng(seed)
    turns = joint_rad[:, None] * rng.normal(size=(keys, len(body.parents), 3))
    return BodyTrack(body, 40_000 * np.arange(keys), turns, root_m * rng.normal(size=(keys, 3)))


def test_errors_that_a_spline_carries_are_its_squared_weights_summed():
    keys = 60
    (weights,) = CubicSpline(np.arange(keys), np.eye(keys))([keys // 2 + 0.5])
    assert np.square(weights).sum() == pytest.approx(_CARRIED, abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_body_at_rest_has_no_motion_apart_from_the_errors_of_its_keys(body, seed):
    rng = np.random.default_rng(seed)
    joint_rad, root_m = rng.uniform(0.005, 0.03, len(body.parents)), 0.01
    found = spline_error(still(body, seed, 2_001, joint_rad, root_m))
    # 1,000 keys of three axes tell a standard deviation to 1.3 %.
    share = np.sqrt(1 + _CARRIED) / _ERROR_RATIO
    assert found.rotation_rad == pytest.approx(share * joint_rad, rel=0.07)
    assert found.translation_m == pytest.approx(share * root_m, rel=0.07)
    missed = torch.tensor([*found.rotation_rad, found.translation_m])
    new = torch.tensor([*joint_rad, root_m])
    assert not apart_from_errors(missed, 1.1 * new).any()
    # Of what remains by chance next to nothing is told from what the spline carries.
    assert (apart_from_errors(missed, new) < 0.01 * new).all()


@pytest.mark.parametrize("seed", range(3))
def test_of_motion_with_errors_the_share_that_is_told_from_them_remains(body, seed):
    """Regression of the motion missed on all that is missed, as least squares has it."""
    rng = np.random.default_rng(seed)
    joints, own = len(body.parents), rng.uniform(0.002, 0.02)
    error = own * rng.uniform(0.2, 3, size=joints)
    seen = np.sqrt(own**2 + (1 + _CARRIED) * error**2 / _ERROR_RATIO**2)
    told = apart_from_errors(torch.from_numpy(seen), torch.from_numpy(error)).numpy()
    motion = own * rng.normal(size=(200_000, joints))
    missed = motion + np.sqrt(_CARRIED) * error * rng.normal(size=motion.shape)
    share = (motion * missed).sum(0) / np.square(missed).sum(0)
    assert told == pytest.approx(own * share, rel=0.03, abs=0.005 * own)


def test_exact_keys_leave_what_is_missed_as_it_is():
    missed = torch.tensor([0.0, 1e-6, 0.003, 2.0])
    assert torch.allclose(apart_from_errors(missed, torch.zeros(4)), missed, rtol=1e-6)
