"""Noise of key poses is told as it was made; smoothing is scipy's and brings poses nearer."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_smoothing_spline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body
from evsplat.body.smoothing import _STIFFNESSES, _misfit, _pieces, motion_noise, smoothed


@pytest.fixture(scope="module")
def body():
    return default_body()


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


@pytest.mark.parametrize(("seed", "size"), [(0, 0.01), (1, 0.02), (2, 0.03), (3, 0.1)])
def test_noise_is_told_and_smoothing_brings_poses_nearer(body, seed, size):
    times, poses, transl = motion(body, seed)
    rng = np.random.default_rng(100 + seed)
    given = jittered(rng, poses, size), transl + 0.5 * size * rng.normal(size=transl.shape)
    track = BodyTrack(body, times, *given)
    noise = motion_noise(track)
    assert noise.rotation_rad == pytest.approx(size, rel=0.1)
    assert noise.translation_m == pytest.approx(0.5 * size, rel=0.3)
    better = smoothed(track, noise)
    assert error_rad(better.poses, poses) < 0.7 * error_rad(given[0], poses)
    assert np.abs(better.transl - transl).mean() < 0.8 * np.abs(given[1] - transl).mean()


@pytest.mark.parametrize("seed", range(3))
def test_exact_poses_show_no_noise_and_stay(body, seed):
    times, poses, transl = motion(body, seed)
    track = BodyTrack(body, times, poses, transl)
    noise = motion_noise(track)
    assert noise.rotation_rad < 1e-3 and noise.translation_m < 1e-3
    assert noise.moving.tolist() == [True] * (len(body.parents) - 3) + [False] * 3
    assert error_rad(smoothed(track, noise).poses, poses) < 1e-3


def test_the_smoothed_root_is_on_the_smoothing_spline_of_scipy(body):
    times, poses, transl = motion(body, 5)
    rng = np.random.default_rng(5)
    times = np.sort(times + rng.integers(-9_000, 9_000, len(times)))  # not in step
    given = transl + 0.02 * rng.normal(size=transl.shape)
    track = BodyTrack(body, times, poses, given)
    noise = motion_noise(track)
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
    assert motion_noise(track).rotation_rad == pytest.approx(0.02, rel=0.05)


def test_few_keys_and_a_body_at_rest_tell_nothing(body):
    times, poses, transl = motion(body, 1, keys=7)
    few = motion_noise(BodyTrack(body, times, poses, transl))
    still = BodyTrack(body, np.arange(20) * 40_000, 0.1 + np.zeros((20, *poses.shape[1:])),
                      np.zeros((20, 3)))  # fmt: skip
    for noise in (few, motion_noise(still)):
        assert noise.rotation_rad == noise.translation_m == 0.0
    assert np.allclose(smoothed(still, motion_noise(still)).poses, still.poses)
