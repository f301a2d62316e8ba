"""Worlds that structure from motion leaves askew stand upright again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evsplat.importers.upright import upright


def level_cameras(rng: np.random.Generator, spread: float, roll: float) -> np.ndarray:
    """Cameras in a world whose z is up: turned about it, pitched anyhow, hardly rolled."""
    poses = []
    for yaw, pitch, rolled in rng.normal(size=(40, 3)) * (spread, 0.3, roll):
        ahead = Rotation.from_euler("ZXY", [yaw, pitch, rolled])
        # camera x is right, y down, z ahead along the world's y
        axes = ahead.as_matrix() @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        pose = np.eye(4)
        pose[:3, :3] = axes.T
        pose[:3, 3] = rng.normal(size=3)
        poses.append(pose)
    return np.stack(poses)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("spread, roll, lean_deg, off_deg", [(0.6, 0.0, 15, 1), (0.5, 0.03, 10, 2)])
def test_what_is_up_is_an_axis_again(seed, spread, roll, lean_deg, off_deg):
    rng = np.random.default_rng(seed)
    cameras = level_cameras(rng, spread, roll)
    askew = Rotation.random(random_state=seed).as_matrix()
    lean = Rotation.from_rotvec(np.radians(lean_deg) * np.array([1.0, 0, 0])).as_matrix()
    cameras[:, :3, :3] = cameras[:, :3, :3] @ askew.T
    turn = upright(cameras, askew @ lean @ [0, 0, 1])
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    up = turn @ askew @ [0, 0, 1]
    assert np.degrees(np.arccos(np.abs(up).max())) < off_deg
    # the nearest axis, so that the world turns no farther than it has to
    assert np.abs(up).argmax() == np.abs(askew @ [0, 0, 1]).argmax()
    assert up @ turn @ askew @ lean @ [0, 0, 1] > 0.9


def test_cameras_that_all_look_one_way_take_up_from_the_body():
    rng = np.random.default_rng(0)
    cameras = np.repeat(level_cameras(rng, 0.0, 0.0)[:1], 5, 0)
    up = upright(cameras, np.array([0.0, 0.2, 1.0])) @ [0, 0.2, 1.0]
    assert up[2] / np.linalg.norm(up) > 1 - 1e-9


def test_a_world_that_stands_upright_stays():
    cameras = level_cameras(np.random.default_rng(1), 0.5, 0.0)
    np.testing.assert_allclose(upright(cameras, np.array([0, 0, 1.0])), np.eye(3), atol=1e-6)
