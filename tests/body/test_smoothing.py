"""Noise of key poses is told as it was made; smoothing is scipy's and brings poses nearer."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_smoothing_spline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.body.smoothing import (
    _STIFFNESSES,
    MotionNoise,
    _misfit,
    _pieces,
    motion_noise,
    moving_joints,
    smoothed,
)


def motion(body, seed: int, keys: int = 60, gap_s: float = 0.04):
    """Key times and a smooth motion of all joints but the last three; turns go beyond a whole."""
    rng = np.random.default_rng(seed)
    joints = len(body.parents)
    seconds = np.arange(keys) * gap_s
    waves = rng.uniform(0.3, 1.5, size=(4, joints, 3)), rng.uniform(0, 6.3, size=(4, joints, 3))
    poses = 0.3 * np.sin(2 * np.pi * waves[0] * seconds[:, None, None, None] + waves[1]).sum(1)
    poses[:, -3:] = 0.2
    poses[:, 0, 2] += 4 * seconds
    transl = np.cumsum(rng.normal(size=(9, 3)), 0)
    transl = 0.1 * CubicSpline(np.linspace(0, seconds[-1], 9), transl)(seconds)
    return np.round(1e6 * seconds).astype(np.int64), poses, transl


def jittered(rng, poses, size: float):
    turns = Rotation.from_rotvec(size * rng.normal(size=(poses[..., 0].size, 3)))
    turned = Rotation.from_rotvec(poses.reshape(-1, 3)) * turns
    return turned.as_rotvec().reshape(poses.shape)


def error_rad(found, truth) -> float:
    apart = Rotation.from_rotvec(found.reshape(-1, 3)).inv() * Rotation.from_rotvec(
        truth.reshape(-1, 3)
    )
    return float(np.sqrt((apart.magnitude() ** 2).mean() / 3))


def noise_of(track: BodyTrack) -> MotionNoise:
    """The same in every joint, of any size."""
    return motion_noise(track, np.ones(track.poses.shape[1]), np.inf)


@pytest.mark.parametrize(("seed", "size"), [(0, 0.01), (1, 0.02), (2, 0.03), (3, 0.1)])
def test_noise_is_told_and_smoothing_brings_poses_nearer(body, seed, size):
    times, poses, transl = motion(body, seed)
    rng = np.random.default_rng(100 + seed)
    given = jittered(rng, poses, size), transl + 0.5 * size * rng.normal(size=transl.shape)
    track = BodyTrack(body, times, *given)
    noise = noise_of(track)
    assert noise.joint_rad[moving_joints(track)] == pytest.approx(size, rel=0.1)
    assert noise.root_m == pytest.approx(0.5 * size, rel=0.3)
    better = smoothed(track, noise)
    assert error_rad(better.poses, poses) < 0.7 * error_rad(given[0], poses)
    assert np.abs(better.transl - transl).mean() < 0.8 * np.abs(given[1] - transl).mean()


@pytest.mark.parametrize("seed", range(3))
def test_exact_poses_show_no_noise_and_stay(body, seed):
    times, poses, transl = motion(body, seed)
    track = BodyTrack(body, times, poses, transl)
    noise = noise_of(track)
    assert noise.joint_rad.max() < 1e-3 and noise.root_m < 1e-3
    assert moving_joints(track).tolist() == [True] * (len(body.parents) - 3) + [False] * 3
    assert error_rad(smoothed(track, noise).poses, poses) < 1e-3


def test_the_smoothed_root_is_on_the_smoothing_spline_of_scipy(body):
    times, poses, transl = motion(body, 5)
    rng = np.random.default_rng(5)
    times = np.sort(times + rng.integers(-9_000, 9_000, len(times)))  # not in step
    given = transl + 0.02 * rng.normal(size=transl.shape)
    track = BodyTrack(body, times, poses, given)
    noise = noise_of(track)
    seconds = (times - times[0]) * 1e-6
    expected = make_smoothing_spline(seconds, given, lam=noise.stiffness_s3[-1])(seconds)
    assert noise.stiffness_s3[-1] > 0
    assert np.allclose(smoothed(track, noise).transl, expected, atol=1e-8)


def test_residual_and_its_freedom_are_those_of_scipys_spline():
    rng = np.random.default_rng(0)
    seconds = np.sort(rng.uniform(0, 2, 30))
    values = rng.normal(size=(30, 2))
    residual, freedom = _misfit(_pieces(seconds), values)
    for index in (20, 45, 60):
        stiffness = _STIFFNESSES[index] * np.median(np.diff(seconds)) ** 3
        smooth = make_smoothing_spline(seconds, np.eye(30), lam=stiffness)(seconds)
        assert residual[index] == pytest.approx(((values - smooth @ values) ** 2).sum(), rel=1e-4)
        assert freedom[index] == pytest.approx(2 * (30 - np.trace(smooth)), rel=1e-4)


def test_long_recordings_are_told_in_pieces(body):
    times, poses, transl = motion(body, 7, keys=700)
    track = BodyTrack(body, times, jittered(np.random.default_rng(7), poses, 0.02), transl)
    assert noise_of(track).joint_rad.max() == pytest.approx(0.02, rel=0.05)


def test_few_keys_and_a_body_at_rest_tell_nothing(body):
    times, poses, transl = motion(body, 1, keys=7)
    few = noise_of(BodyTrack(body, times, poses, transl))
    still = BodyTrack(body, np.arange(20) * 40_000, 0.1 + np.zeros((20, *poses.shape[1:])),
                      np.zeros((20, 3)))  # fmt: skip
    for noise in (few, noise_of(still)):
        assert not noise.joint_rad.any() and noise.root_m == 0.0
    assert np.allclose(smoothed(still, noise_of(still)).poses, still.poses)


def test_each_joint_is_smoothed_by_its_own_noise_and_an_exact_one_stays(body):
    times, poses, transl = motion(body, 3)
    rng, joints = np.random.default_rng(3), len(body.parents)
    size = np.where(np.arange(joints) % 3 == 0, 0.01, 0.04)
    size[5:8] = 0.0
    turned = np.stack([jittered(rng, poses[:, j], size[j]) for j in range(joints)], 1)
    track = BodyTrack(body, times, turned, transl)
    noise = motion_noise(track, 2 * size, 0.0)  # known in proportion, not in size
    moving = moving_joints(track)
    assert noise.joint_rad[moving] == pytest.approx(size[moving], rel=0.15)
    better = smoothed(track, noise)
    assert np.allclose(better.poses[:, 5:8], turned[:, 5:8], atol=1e-12)
    for group in (size == 0.04, size == 0.01):
        assert error_rad(better.poses[:, group], poses[:, group]) < 0.8 * error_rad(
            turned[:, group], poses[:, group]
        )
    # The quiet ones taken for as noisy as the others: some of their motion goes with the noise.
    quiet = size == 0.01
    alike = smoothed(track, motion_noise(track, np.full(joints, 0.04), 0.0))
    assert error_rad(better.poses[:, quiet], poses[:, quiet]) < error_rad(
        alike.poses[:, quiet], poses[:, quiet]
    )


def test_no_more_noise_is_believed_than_was_expected(body):
    times, poses, transl = motion(body, 4)
    rng, joints = np.random.default_rng(4), len(body.parents)
    jump = np.zeros((len(times), 1))
    jump[30:] = 0.5
    track = BodyTrack(body, times, jittered(rng, poses, 0.05), transl + jump)
    noise = motion_noise(track, np.full(joints, 0.01), 0.002)
    assert noise.joint_rad[moving_joints(track)] == pytest.approx(0.01)
    assert noise.root_m == 0.002
    assert np.abs(smoothed(track, noise).transl - track.transl).max() < 0.05


@pytest.mark.parametrize("rate", [1.0, 6.0])
def test_a_constant_spin_costs_nothing_over_any_number_of_turns(body, rate):
    seconds = 0.04 * np.arange(60)
    poses = np.zeros((60, len(body.parents), 3))
    poses[:, 0] = np.outer(rate * seconds, [0.0, 0.6, 0.8])
    track = BodyTrack(body, np.round(1e6 * seconds).astype(np.int64), poses, np.zeros((60, 3)))
    assert noise_of(track).joint_rad[0] < 1e-4
    # Whatever its stiffness: quaternions of a constant spin lie on a circle, and their spline on
    # one with the same centre, away from its ends.
    stiff = MotionNoise(np.zeros(1), 0.0, np.r_[1e-4, np.zeros(len(body.parents))])
    assert error_rad(smoothed(track, stiff).poses[20:-20, 0], poses[20:-20, 0]) < 1e-4
