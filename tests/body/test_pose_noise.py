import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evsplat.body.pose_noise import (
    NOISE_PRESETS,
    PoseNoise,
    joint_angles,
    noise_errors,
    noisy_poses,
    poses_off_by,
)
from evsplat.body.skeleton import find_skeleton
from evsplat.errors import ConfigError

from .helpers import posed_joints


def bent_poses(body, times, seed=0):
    moving = joint_angles(body, PoseNoise(1, 1, 0, 0)) > 0
    rng = np.random.default_rng(seed)
    return 0.5 * rng.normal(size=(times, len(moving), 3)) * moving[:, None]


def wrists_and_ankles(body):
    limbs = find_skeleton(body.parents.tolist(), body.joint_names).limbs
    return [limbs[f"{side}_{part}"] for side in ("left", "right") for part in ("hand", "foot")]


@pytest.mark.parametrize(
    ("preset", "axes", "millimetres"),
    [
        ("one_percent", [0, 1, 2], 17),
        ("two_percent", [0, 1, 2], 34),
        ("sharp_video", [0, 2], 56),
        ("blurry_video", [0, 2], 109),
    ],
)
def test_wrists_and_ankles_are_off_by_what_the_preset_says(body, preset, axes, millimetres):
    poses, still = bent_poses(body, 200), np.zeros((200, 3))
    times = np.arange(200) * 40_000
    ends = wrists_and_ankles(body)
    found = []
    for seed in range(3):
        moved = noisy_poses(body, poses, still, times, preset, seed=seed, view=(0, 1, 0))
        off = posed_joints(body, *moved) - posed_joints(body, poses, still)
        found.append(np.linalg.norm(off[:, ends][..., axes], axis=-1).mean())
    assert 1000 * np.mean(found) == pytest.approx(millimetres, rel=0.06)


def test_spread_and_correlation_in_time_are_those_asked_for(body):
    noise = PoseNoise(0.1, 0.05, 0.02, 0.06, correlation_s=0.2, jitter=0.25)
    times = np.arange(0, 15_000_000, 100_000)
    poses = np.zeros((len(times), len(body.parents), 3))
    expected = joint_angles(body, noise)
    lag = 2  # a correlation time
    squares, products, shifts = [], [], []
    for seed in range(20):
        moved, transl = noisy_poses(body, poses, np.zeros((len(times), 3)), times, noise, seed=seed)
        squares.append((moved**2).mean((0, 2)))
        products.append((moved[lag:] * moved[:-lag]).mean((0, 2)))
        shifts.append(transl.std(0))
    assert np.allclose(np.sqrt(np.mean(squares, 0)), expected, rtol=0.06)
    ratio = (np.mean(products, 0) / np.maximum(np.mean(squares, 0), 1e-12))[expected > 0]
    assert np.allclose(ratio, 0.75 * np.exp(-0.5), atol=0.06)
    assert np.allclose(np.mean(shifts, 0), [0.02, 0.02, 0.06], rtol=0.08)


def test_sparse_and_dense_poses_err_alike_at_the_same_time(body):
    noise = PoseNoise(0.1, 0.05, 0.02, 0.06, jitter=0.0)
    dense = np.arange(40) * 5_000
    keys = dense[::8]
    poses = bent_poses(body, 40)
    transl = np.random.default_rng(1).normal(size=(40, 3))
    full = noisy_poses(body, poses, transl, dense, noise, seed=3)
    some = noisy_poses(body, poses[::8], transl[::8], keys, noise, seed=3)
    same = Rotation.from_rotvec(full[0][::8].reshape(-1, 3)) * (
        Rotation.from_rotvec(some[0].reshape(-1, 3)).inv()
    )
    assert same.magnitude().max() < 1e-9
    assert np.allclose(full[1][::8], some[1], atol=1e-12)
    again = noisy_poses(body, poses, transl, dense, noise, seed=3)
    assert np.array_equal(again[0], full[0])
    assert not np.allclose(noisy_poses(body, poses, transl, dense, noise, seed=4)[0], full[0])


def test_depth_errs_along_the_view_only(body):
    view = np.array([0.6, 0.0, 0.8])
    noise = PoseNoise(0.0, 0.0, 0.0, 0.1)
    still = np.zeros((50, 3))
    poses = bent_poses(body, 50)
    moved, transl = noisy_poses(
        body, poses, still, np.arange(50) * 40_000, noise, seed=0, view=tuple(view)
    )
    assert np.allclose(transl, (transl @ view)[:, None] * view, atol=1e-12)
    assert np.abs(transl).max() > 0.05
    assert np.allclose(moved, poses, atol=1e-9)


def test_an_unknown_preset_is_named(body):
    with pytest.raises(
        ConfigError, match=f"No pose noise 'x'; there are {', '.join(NOISE_PRESETS)}"
    ):
        noisy_poses(body, np.zeros((1, 31, 3)), np.zeros((1, 3)), np.zeros(1), "x", seed=0)


@pytest.mark.parametrize("millimetres", [5, 17, 34])
def test_errors_can_be_scaled_to_a_distance(body, millimetres):
    poses, still = bent_poses(body, 38), np.zeros((38, 3))
    times = np.arange(38) * 40_000
    ends = wrists_and_ankles(body)
    seen = []
    for seed in (1, 2):
        *moved, error, noise = poses_off_by(
            body, poses, still, times, millimetres / 1000, seed=seed
        )
        off = np.linalg.norm(
            posed_joints(body, *moved) - posed_joints(body, poses, still), axis=-1
        )[:, ends]
        assert 1000 * off.mean() == pytest.approx(millimetres, rel=0.02)
        assert error == pytest.approx(off.mean(), rel=1e-6)
        assert noise.joint_rad / noise.depth_m == pytest.approx(0.0116 / 0.012)
        seen.append(moved[0])
    assert not np.allclose(seen[0], seen[1])
    untouched = poses_off_by(body, poses, still, times, 0.0, seed=1)
    assert untouched[0] is poses and untouched[2] == 0
    errors = noise_errors(body, untouched[3], 38, "exact")
    assert errors.joint_rad.max() == errors.root_m.max() == 0


def test_stated_errors_are_those_that_were_drawn(body):
    """Root mean squares over many seeds of one pose, in a view that looks askew."""
    noise = NOISE_PRESETS["one_percent"]
    poses, still, view = bent_poses(body, 4), np.zeros((4, 3)), (0.6, 0.0, 0.8)
    times = np.arange(4) * 10_000_000  # far enough apart to be independent
    turns, shifts = [], []
    for seed in range(150):
        moved, transl = noisy_poses(body, poses, still, times, noise, seed=seed, view=view)
        pairs = (
            Rotation.from_rotvec(poses.reshape(-1, 3)),
            Rotation.from_rotvec(moved.reshape(-1, 3)),
        )
        turns.append((pairs[0].inv() * pairs[1]).as_rotvec().reshape(poses.shape))
        shifts.append(transl)
    stated = noise_errors(body, noise, 4, "estimated", view=view)
    drawn = np.sqrt(np.mean(np.square(turns), axis=(0, 1, 3)))
    # 1,800 numbers know a standard deviation to 2 %, 600 to 3 %
    assert drawn == pytest.approx(stated.joint_rad[0], rel=0.08, abs=1e-9)
    assert np.sqrt(np.mean(np.square(shifts), axis=(0, 1))) == pytest.approx(
        stated.root_m[0], rel=0.1
    )
    assert stated.joint_rad.shape == (4, 31) and stated.source == "estimated"
