"""Between pictures a motion follows a curve through what they show, and nothing else moves."""

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, PoseErrors
from evsplat.posing.bridging import _GOES_ON_S, _LONGEST_END_S, _LONGEST_S, _SMOOTH_S, bridged

EXPOSURE_US, PERIOD_US, FRAMES = 30_000, 66_000, 14


def smooth_motion(body, seed: int):
    """Poses (T, J, 3) and places (T, 3) at any times, with turns beyond a whole one."""
    rng = np.random.default_rng(seed)
    joints = len(body.parents)
    rate, phase = rng.uniform(0.2, 0.9, (joints, 3)), rng.uniform(0, 6.3, (joints, 3))

    def at(times_us):
        seconds = np.asarray(times_us)[:, None, None] * 1e-6
        poses = 0.4 * np.sin(2 * np.pi * rate * seconds + phase)
        poses[:, 0, 2] += 5 * seconds[:, 0, 0]
        return poses, poses[:, 1] * 0.3

    return at


def recording(seed: int):
    """Times of pictures, those of a held-out frame missing, and times of keys."""
    rng = np.random.default_rng(seed)
    held = set(rng.choice(np.arange(1, FRAMES - 1), 3, replace=False).tolist())
    starts = PERIOD_US * np.arange(FRAMES)
    instants = np.array([0.05, 0.5, 0.95]) * EXPOSURE_US
    shown = [start + instants for frame, start in enumerate(starts) if frame not in held]
    keys = np.arange(0, starts[-1] + EXPOSURE_US + 1, 6_000)
    return np.concatenate(shown).round().astype(np.int64), keys


def around(keys, shown):
    """Indices of the pictures before and after."""
    following = np.searchsorted(shown, keys, side="right").clip(1, len(shown) - 1)
    return following - 1, following


def unseen(keys, shown):
    """Keys between the pictures of different exposures."""
    before, after = around(keys, shown)
    inside = (keys > shown[0]) & (keys < shown[-1])
    return inside & (shown[after] - shown[before] > EXPOSURE_US)


def turned_rad(a, b):
    first, second = (Rotation.from_rotvec(each.reshape(-1, 3)) for each in (a, b))
    return (first.inv() * second).magnitude()


@pytest.mark.parametrize("seed", range(4))
def test_what_is_wrong_between_pictures_alone_is_mended(body, seed):
    shown, keys = recording(seed)
    poses, places = smooth_motion(body, seed)(keys)
    gap = unseen(keys, shown)
    rng = np.random.default_rng(100 + seed)
    wrong, moved = poses.copy(), places.copy()
    # Drawn towards a usual pose, as by a prior, farthest in the middle of a gap.
    deep = np.minimum(*(np.abs(keys - shown[i]) for i in around(keys, shown)))[gap] / EXPOSURE_US
    wrong[gap] += deep[:, None, None] * 0.4 * rng.normal(size=poses.shape[1:])
    moved[gap] += deep[:, None] * 0.2 * rng.normal(size=3)
    before = turned_rad(wrong[gap], poses[gap]).mean()
    found = bridged(BodyTrack(body, keys, wrong, moved), shown.tolist())
    assert turned_rad(found.poses[gap], poses[gap]).mean() < 0.1 * before
    assert np.abs(found.transl - places)[gap].mean() < 0.1 * np.abs(moved - places)[gap].mean()
    rotations, _ = found.at(shown.tolist())
    true, _ = BodyTrack(body, keys, wrong, moved).at(shown.tolist())
    apart = Rotation.from_matrix(rotations.reshape(-1, 3, 3).numpy()).inv() * Rotation.from_matrix(
        true.reshape(-1, 3, 3).numpy()
    )
    assert apart.magnitude().max() < 0.02, "poses at the pictures stay"


@pytest.mark.parametrize("seed", range(3))
def test_places_lie_on_scipys_smoothing_spline_and_what_it_misses(body, seed):
    shown, keys = recording(seed)
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(len(keys), 3))
    track = BodyTrack(body, keys, np.zeros((len(keys), len(body.parents), 3)), places)
    found = bridged(track, shown.tolist())
    at, seconds = track.at(shown.tolist())[1].double().numpy(), shown * 1e-6
    span = seconds[-1] - seconds[0]
    curve = make_smoothing_spline(seconds, at, lam=_SMOOTH_S**4 * len(shown) / span)
    inside = (keys > shown[0]) & (keys < shown[-1])
    missed = at - curve(seconds)
    expected = curve(keys * 1e-6) + np.stack(
        [np.interp(keys * 1e-6, seconds, column) for column in missed.T], 1
    )
    np.testing.assert_allclose(found.transl[inside], expected[inside], atol=1e-6)
    for end, beyond in ((0, keys < shown[0]), (-1, keys > shown[-1])):
        assert beyond.any()
        away = (keys[beyond] - shown[end]) * 1e-6
        rests = np.sign(away) * _GOES_ON_S * (1 - np.exp(-np.abs(away) / _GOES_ON_S))
        goes_on = at[end] + rests[:, None] * curve.derivative()(seconds[end])
        np.testing.assert_allclose(found.transl[beyond], goes_on, atol=1e-5)


def test_long_ends_long_gaps_and_what_is_told_stay(body):
    shown, _ = recording(0)
    begins = int(1e6 * _LONGEST_END_S) + 10_000
    shown = begins + shown[shown < 300_000]
    later = np.arange(5) * 10_000 + shown[-1] + int(1e6 * _LONGEST_S) + 20_000
    keys = np.arange(0, later[-1] + begins, 7_000)
    poses, places = smooth_motion(body, 7)(keys)
    poses = poses + 0.05 * np.random.default_rng(1).normal(size=poses.shape)
    joints = len(body.parents)
    errors = PoseErrors(
        "estimated", np.full((len(keys), joints), 0.1), np.full((len(keys), 3), 0.2)
    )
    up = body.rest_joints.new_tensor([0.0, 0.0, 1.0])
    given = BodyTrack(body, keys, poses, places, errors=errors, camera_up=up, up=up)
    found = bridged(given, [*shown.tolist(), *later.tolist()])
    kept = (keys < shown[0]) | (keys > later[-1]) | ((keys > shown[-1]) & (keys < later[0]))
    assert kept.sum() > 100 and not kept.all()
    assert turned_rad(found.poses[kept], poses[kept]).max() < 1e-6
    assert turned_rad(found.poses[~kept], poses[~kept]).max() > 0.02
    assert found.errors is errors and found.up is up and found.camera_up is up


def test_of_few_pictures_nothing_is_said(body):
    _, keys = recording(0)
    track = BodyTrack(body, keys, *smooth_motion(body, 0)(keys))
    assert bridged(track, keys[:4].tolist()) is track
    assert bridged(track, [-5, 10**9, *keys[:4].tolist()]) is track
