"""Pose splines against scipy's, their smoothness, and their error between real key poses."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from evsplat.body import BodyTrack, make_body
from evsplat.errors import DataError

from .helpers import random_rig


def make_track(seed, keys, joints=5, spread=0.7):
    rng = np.random.default_rng(seed)
    body, _ = make_body(**random_rig(seed, joints=joints))
    times = 1_000_000 * seed + np.cumsum(rng.integers(10_000, 90_000, keys))  # not uniform
    walk = Rotation.identity(joints)
    poses = []
    for _ in range(keys):
        walk = walk * Rotation.from_rotvec(spread * rng.normal(size=(joints, 3)))
        poses.append(walk.as_rotvec())
    poses, transl = np.stack(poses), rng.normal(size=(keys, 3))
    return BodyTrack(body, times, poses, transl), poses, transl


@pytest.mark.parametrize("seed", range(4))
def test_track_equals_scipy_splines_between_uneven_keys(seed):
    track, poses, places = make_track(seed, keys=4 + 3 * seed)
    times = np.linspace(track.times_us[0], track.times_us[-1], 57).astype(np.int64)
    rotations, transl = track.at(torch.from_numpy(times))
    seconds, at = (track.times_us - track.times_us[0]) * 1e-6, (times - track.times_us[0]) * 1e-6
    for joint in range(poses.shape[1]):
        spline = RotationSpline(seconds, Rotation.from_rotvec(poses[:, joint]))
        assert np.abs(rotations[:, joint].numpy() - spline(at).as_matrix()).max() < 1e-6
    assert rotations.dtype == transl.dtype == torch.float32
    assert np.abs(transl.numpy() - CubicSpline(seconds, places)(at)).max() < 1e-6


def test_vertices_at_many_times_are_blended_bones_of_each(rng: np.random.Generator):
    seed = int(rng.integers(10_000))
    track, _, _ = make_track(seed, keys=5)
    rng = np.random.default_rng(seed)
    times = rng.integers(track.times_us[0] - 5_000, track.times_us[-1] + 5_000, 7).tolist()
    rest = torch.nn.functional.pad(track.body.canonical_vertices(), (0, 1), value=1.0).double()
    found = list(track.vertices_at(times))
    assert len(found) == len(times)
    for time, vertices in zip(times, found, strict=True):
        moved = torch.einsum("jab,vb->vja", track.bones([time])[0].double(), rest)
        expected = (track.body.weights.double()[..., None] * moved).sum(1)[:, :3]
        assert (vertices - expected).abs().max() < 1e-5, seed
        assert torch.equal(vertices, track.vertices(time)), seed


@pytest.mark.parametrize("keys", [1, 2, 3, 9])
def test_keys_are_hit_exactly_and_held_beyond_the_ends(keys):
    track, poses, _ = make_track(11, keys)
    rotations, _ = track.at(track.times_us)
    expected = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(keys, -1, 3, 3)
    assert np.abs(rotations.numpy() - expected).max() < 1e-6
    outside = track.at([int(track.times_us[0]) - 10**9, int(track.times_us[-1]) + 10**9])
    ends = track.at(track.times_us[[0, -1]])
    assert torch.equal(outside[0], ends[0]) and torch.equal(outside[1], ends[1])


def test_rates_that_were_found_once_are_those_of_the_poses_and_times_given(monkeypatch):
    """A motion is read several times; what was found of it is nobody's to change."""
    track, poses, places = make_track(3, keys=7)
    faster = track.times_us[0] + (track.times_us - track.times_us[0]) // 2
    first = BodyTrack(track.body, track.times_us, poses, places)
    first._rates.zero_()
    others = [
        (track.times_us, poses),
        (faster, poses),
        (track.times_us, poses[::-1].copy()),
        (track.times_us[:4], poses[:4]),
    ]
    found = [BodyTrack(track.body, t, p, places[: len(t)])._rates for t, p in others]
    monkeypatch.setattr("evsplat.body.track._KEPT_KEYS", 0)
    for (times_us, given), rates in zip(others, found, strict=True):
        afresh = BodyTrack(track.body, times_us, given, places[: len(times_us)])._rates
        assert torch.equal(rates, afresh) and bool(rates.any())


def test_a_long_recording_is_posed_as_a_short_one(monkeypatch):
    """Whose polynomials are not kept."""
    short, _, _ = make_track(3, keys=40)
    monkeypatch.setattr("evsplat.body.track._KEPT_KEYS", 39)
    long, _, _ = make_track(3, keys=40)
    assert long._known is None and short._known is not None
    times = np.linspace(short.times_us[0] - 9, short.times_us[-1] + 9, 333).astype(np.int64)
    for one, other in zip(long.at(times), short.at(times), strict=True):
        assert torch.equal(one, other)


def test_two_keys_are_slerp_and_straight_line():
    track, poses, _ = make_track(5, keys=2)
    middle = track.times_us[0] + np.arange(0, np.diff(track.times_us)[0], 1000)
    rotations, transl = track.at(middle)
    share = (middle - track.times_us[0]) / np.diff(track.times_us)[0]
    for joint in range(poses.shape[1]):
        slerp = Slerp([0, 1], Rotation.from_rotvec(poses[:, joint]))
        assert np.abs(rotations[:, joint].numpy() - slerp(share).as_matrix()).max() < 1e-6
    ends = track.at(track.times_us)[1]
    line = ends[0] + torch.tensor(share)[:, None] * (ends[1] - ends[0])
    assert (transl - line).abs().max() < 1e-6


def test_angular_velocity_and_acceleration_are_continuous_at_the_keys():
    track, poses, _ = make_track(6, keys=8)
    step = 2e-5  # seconds; the polynomials themselves are evaluated, in float64, without rounding
    for knot in range(1, 7):
        length = float(track._seconds[knot] - track._seconds[knot - 1])

        def path(interval, offsets):
            at = torch.full((3,), interval)
            values = track._turned(at, torch.tensor(offsets, dtype=torch.float64)).numpy()
            base = Rotation.from_rotvec(poses[interval])
            return [base * Rotation.from_rotvec(value) for value in values]

        def derivatives(interval, at):
            before, middle, after = path(interval, (at - step, at, at + step))
            forward = (middle.inv() * after).as_rotvec()
            backward = (middle.inv() * before).as_rotvec()
            return (forward - backward) / (2 * step), (forward + backward) / step**2

        velocity_end, acceleration_end = derivatives(knot - 1, length)
        velocity_start, acceleration_start = derivatives(knot, 0.0)
        scale = np.abs(acceleration_start).max()
        assert np.abs(velocity_end - velocity_start).max() < 1e-4 * np.abs(velocity_start).max()
        # Second differences lose digits to 1e-16 / step^2, and scipy's solver stops at 1e-9.
        assert np.abs(acceleration_end - acceleration_start).max() < 1e-3 * scale


@pytest.mark.parametrize(
    "change, message",
    [
        ({"times_us": np.array([0, 5, 5])}, r"times_us\[2\] = 5 does not follow 5"),
        ({"times_us": np.array([0, 5])}, r"poses has shape \(3, 4, 3\), expected \(2, 4, 3\)"),
        ({"poses": np.full((3, 4, 3), np.nan)}, r"poses\[0\] is not finite"),
        ({"transl": np.zeros((3, 2))}, r"transl has shape \(3, 2\)"),
        ({"poses": np.zeros((3, 5, 3))}, r"poses has shape \(3, 5, 3\)"),
    ],
)
def test_bad_key_poses_are_refused_by_name(change, message):
    body, _ = make_body(**random_rig(0, joints=4))
    arrays = {"times_us": np.array([0, 5, 9]), "poses": np.zeros((3, 4, 3))}
    arrays = {**arrays, "transl": np.zeros((3, 3)), **change}
    with pytest.raises(DataError, match=message):
        BodyTrack(body, **arrays)
