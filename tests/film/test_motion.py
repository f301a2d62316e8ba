"""Another motion on a recorded body: where it stands, where it faces, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body
from evsplat.body.motion import load_motion
from evsplat.body.smpl_skeleton import JOINTS
from evsplat.errors import ConfigError, DataError
from evsplat.film.motion import load_motion_of, place_motion
from evsplat.staging.assets import find_motion


def _recorded(turn: Rotation, place: np.ndarray) -> BodyTrack:
    """The shipped body standing somewhere, in a world of any axes (its rest pose is z up)."""
    body = default_body()
    poses = np.zeros((2, len(body.parents), 3))
    poses[:, 0] = turn.as_rotvec()
    root = body.rest_joints[0].double().numpy()
    return BodyTrack(body, np.array([5, 6]) * 100_000, poses, np.tile(place - root, (2, 1)))


WORLDS = {
    "z up": Rotation.identity(),
    "y up": Rotation.from_euler("x", -90, degrees=True),
    "y down": Rotation.from_euler("x", 90, degrees=True),
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("yaw", [0.0, 130.0])
def test_a_motion_starts_facing_and_standing_as_the_recorded_person(world, yaw):
    upright = WORLDS[world]
    up = upright.apply([0.0, 0, 1])
    turn = Rotation.from_rotvec(np.radians(yaw) * up) * upright
    place = np.array([1.5, -0.4, 2.5])
    recorded = _recorded(turn, place)
    moved = load_motion_of("walk", recorded, in_place=True)
    assert moved.times_us[0] == 0 and moved.body.parents.equal(recorded.body.parents)

    def lowest(track, time):
        return float((track.vertices(time) @ torch.from_numpy(up).float()).min())

    soles = [lowest(moved, int(t)) for t in np.linspace(0, moved.times_us[-1], 12)]
    assert np.percentile(soles, 10) == pytest.approx(lowest(recorded, 500_000), abs=0.03)
    root = moved.at([0, int(moved.times_us[-1]) // 2])[1] + moved.body.rest_joints[0]
    away = root.double().numpy() - place
    assert np.abs(away - np.outer(away @ up, up)).max() < 1e-3
    # Hips to the left, as the recorded ones: walking turns them a little.
    first = moved.at([0])[0][0, 0].double().numpy() @ [1.0, 0, 0]
    flat = first - up * (first @ up)
    across = turn.apply([1.0, 0, 0])
    assert flat @ across / np.linalg.norm(flat) > np.cos(np.radians(3))


def test_travel_is_kept_unless_asked_otherwise_and_the_middle_of_the_way_is_the_spot():
    place = np.array([0.0, 0.9, -3.0])
    recorded = _recorded(Rotation.identity(), place)
    motion = load_motion(find_motion("run"))
    moved = place_motion(motion, recorded, up=np.array([0.0, 0, 1]))
    root = (moved.at(moved.times_us.tolist())[1] + moved.body.rest_joints[0]).numpy()
    assert np.ptp(root, axis=0)[:2].max() > 0.5
    np.testing.assert_allclose((root.max(0) + root.min(0))[:2] / 2, place[:2], atol=1e-5)


def test_the_same_motion_in_another_world_is_the_same_motion():
    recorded = _recorded(WORLDS["z up"], np.zeros(3))
    motion = load_motion(find_motion("kick"))
    lain = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    other = replace(motion, world_from_source=lain @ motion.world_from_source)
    first = place_motion(motion, recorded, up=np.array([0.0, 0, 1]))
    second = place_motion(other, recorded, up=np.array([0.0, 1, 0]))
    times = np.linspace(0, first.times_us[-1], 5).astype(int).tolist()
    for a, b in zip(first.at(times), second.at(times), strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=0)


def test_pose_files_need_a_rate_and_follow_it(tmp_path):
    count = 4
    path = tmp_path / "walk.npz"
    np.savez(
        path,
        poses=np.zeros((count, 3 * JOINTS["smplh"])),
        trans=np.linspace(0, 1, count)[:, None] * np.eye(3)[:1],
        betas=np.zeros(10),
        gender="neutral",
        mocap_framerate=20.0,
    )
    recorded = _recorded(WORLDS["z up"], np.zeros(3))
    assert load_motion_of(str(path), recorded).times_us.tolist() == [0, 50_000, 100_000, 150_000]
    assert load_motion_of(str(path), recorded, fps=40).times_us.tolist()[-1] == 75_000


@pytest.mark.parametrize("name", ["walk", str(find_motion("walk"))])
def test_a_motion_with_times_of_its_own_takes_no_other_rate(name):
    recorded = _recorded(Rotation.identity(), np.zeros(3))
    with pytest.raises(ConfigError, match="--motion-fps 60: .*walk.* has times of its own"):
        load_motion_of(name, recorded, fps=60.0)


def test_unknown_motions_are_told_with_those_that_ship():
    recorded = _recorded(Rotation.identity(), np.zeros(3))
    with pytest.raises(DataError, match=r"--motion walc: .*backflip.*walk"):
        load_motion_of("walc", recorded)


def test_a_pose_file_without_a_rate_asks_for_one(tmp_path):
    path = tmp_path / "poses.npz"
    poses = np.zeros((3, 3 * JOINTS["smpl"]))
    np.savez(path, poses=poses, trans=np.zeros((3, 3)), betas=np.zeros(10))
    recorded = _recorded(Rotation.identity(), np.zeros(3))
    with pytest.raises(ConfigError, match="--motion-fps"):
        load_motion_of(str(path), recorded)
