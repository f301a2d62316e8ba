"""Where a moving camera is between its frames, against motions that are known."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.camera import Camera
from evsplat.capture import Frame
from evsplat.capture.camera_track import CameraTrack
from evsplat.staging.camera import CameraPath, make_camera

EXPOSURE_US = 30_000
K = torch.tensor([[110.0, 0, 48.0], [0, 110.0, 40.0], [0, 0, 1]])
CAMERA = Camera(96, 80, K, torch.eye(4))


def frame_at(mid_us: int, pose, index: int = 0, exposure_us: int = EXPOSURE_US) -> Frame:
    span = mid_us - exposure_us // 2, mid_us + exposure_us // 2
    given = None if pose is None else torch.as_tensor(pose).float()
    return Frame(f"{index}", index, "main", "0.png", span, "train", world_to_camera=given)


class EvenMotion:
    """A camera that turns about one axis of its own and goes straight on, at constant speeds."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.start = Rotation.random(random_state=rng)
        self.rate = rng.normal(size=3)  # radians per second
        self.place, self.velocity = rng.normal(size=(2, 3))
        gaps = rng.integers(20_000, 120_000, size=6)
        self.mids = (int(rng.integers(0, 10**6)) + np.cumsum(gaps)).tolist()

    def pose(self, time_us: int) -> np.ndarray:
        seconds = time_us * 1e-6
        to_world = self.start * Rotation.from_rotvec(self.rate * seconds)
        pose = np.eye(4)
        pose[:3, :3] = to_world.inv().as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (self.place + self.velocity * seconds)
        return pose

    def track(self, keys: int) -> CameraTrack:
        frames = [frame_at(mid, self.pose(mid), k) for k, mid in enumerate(self.mids[:keys])]
        return CameraTrack(CAMERA, frames)


@pytest.mark.parametrize("keys", [2, 3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_even_motion_is_met_between_frames_and_to_the_ends_of_the_first_and_last_exposure(
    seed, keys
):
    motion = EvenMotion(seed)
    half = EXPOSURE_US // 2
    times = (
        np.linspace(motion.mids[0] - half, motion.mids[keys - 1] + half, 41).astype(int).tolist()
    )
    for time, camera in zip(times, motion.track(keys).at(times), strict=True):
        found = camera.world_to_camera.double().numpy()
        np.testing.assert_allclose(found, motion.pose(time), atol=2e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_point_at_rest_goes_through_the_picture_as_predicted(seed):
    motion = EvenMotion(seed)
    middle = motion.mids[2]
    # Three metres ahead at the middle of an exposure, near the middle of the picture.
    ahead = np.linalg.inv(motion.pose(middle)) @ [0.2, -0.1, 3.0, 1.0]
    point = torch.from_numpy(ahead[:3]).float()
    times = [middle - EXPOSURE_US // 2, middle, middle + EXPOSURE_US // 2]
    pixels = []
    for time, camera in zip(times, motion.track(6).at(times), strict=True):
        seen = (motion.pose(time) @ ahead)[:3]
        pixels.append(camera.project(point)[0].numpy())
        expected = 110.0 * seen[:2] / seen[2] + [48.0, 40.0]
        np.testing.assert_allclose(pixels[-1], expected, atol=2e-3)
    assert np.abs(pixels[2] - pixels[0]).max() > 0.5


def test_at_the_middle_of_a_frame_it_has_the_pose_that_was_given():
    motion = EvenMotion(0)
    for time, camera in zip(motion.mids, motion.track(6).at(motion.mids), strict=True):
        assert torch.equal(camera.world_to_camera, torch.from_numpy(motion.pose(time)).float())


def test_beyond_the_first_and_last_exposure_it_stands():
    motion = EvenMotion(1)
    first, last = motion.mids[0], motion.mids[-1]
    half = EXPOSURE_US // 2
    cameras = motion.track(6).at([first - 10**7, first - half, last + half, last + 10**7])
    poses = [camera.world_to_camera for camera in cameras]
    assert torch.equal(poses[0], poses[1]) and torch.equal(poses[2], poses[3])
    assert not torch.allclose(poses[1], poses[2], atol=0.01)


@pytest.mark.parametrize("pose", [None, 2 * torch.rand(4, 4)])
def test_a_camera_that_stands_is_one_object_at_all_times(pose):
    track = CameraTrack(CAMERA, [frame_at(mid, pose) for mid in (0, 50_000, 100_000)])
    cameras = track.at([-5, 20_000, 10**9])
    assert all(camera is track.camera for camera in cameras)
    given = CAMERA.world_to_camera if pose is None else pose
    assert torch.equal(track.camera.world_to_camera, given)


def test_a_camera_of_no_frame_stands():
    assert CameraTrack(CAMERA, []).at([0, 1]) == (CAMERA, CAMERA)


def test_frames_without_a_pose_have_that_of_the_camera():
    moved = torch.eye(4)
    moved[0, 3] = 0.5
    track = CameraTrack(CAMERA, [frame_at(0, None), frame_at(100_000, moved, 1)])
    at = [camera.world_to_camera for camera in track.at([0, 50_000, 100_000])]
    assert torch.equal(at[0], torch.eye(4)) and torch.equal(at[2], moved)
    assert float(at[1][0, 3]) == pytest.approx(0.25, abs=1e-6)


def test_of_exposures_with_one_middle_the_first_tells():
    motion = EvenMotion(2)
    frames = [frame_at(mid, motion.pose(mid), k) for k, mid in enumerate(motion.mids)]
    within = frame_at(motion.mids[3], motion.pose(0), 9, EXPOSURE_US // 2)
    times = np.linspace(motion.mids[0], motion.mids[-1], 13).astype(int).tolist()
    plain, more = (CameraTrack(CAMERA, each).at(times) for each in (frames, [*frames, within]))
    for one, other in zip(plain, more, strict=True):
        assert torch.equal(one.world_to_camera, other.world_to_camera)


@pytest.mark.parametrize("motion", ["handheld", "orbit"])
@pytest.mark.parametrize("seed", range(3))
def test_the_way_of_a_staged_camera_is_met_far_better_than_by_the_nearest_frame(motion, seed):
    """Mean error in pixels of points about the person, at 96 px and 20 frames per second."""
    path = CameraPath(motion, 1.0, orbit_deg=40, seed=seed)
    mids = list(range(15_000, 1_000_000, 50_000))
    camera = make_camera((0.25, -3.35, 1.35), 96, 96)
    poses = path.at(np.array(mids))
    frames = [frame_at(mid, pose) for mid, pose in zip(mids, poses, strict=True)]
    track = CameraTrack(camera, frames)
    rng = np.random.default_rng(seed)
    times = np.sort(rng.integers(0, mids[-1] + 15_000, size=200)).tolist()
    points = torch.from_numpy(rng.uniform([-1, -1, 0], [1, 2, 2], size=(50, 3))).float()
    true = path.at(np.array(times))
    missed = {"track": [], "nearest": []}
    for time, pose, found in zip(times, true, track.at(times), strict=True):
        nearest = poses[int(np.abs(np.array(mids) - time).argmin())]
        there = _at(camera, torch.from_numpy(pose).float(), points)
        missed["track"].append((found.project(points)[0] - there).norm(dim=-1).mean())
        other = _at(camera, torch.from_numpy(nearest).float(), points)
        missed["nearest"].append((other - there).norm(dim=-1).mean())
    errors = {name: float(torch.stack(values).mean()) for name, values in missed.items()}
    assert errors["track"] < 0.01
    assert errors["nearest"] > 10 * errors["track"]


def _at(camera: Camera, pose: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    return Camera(camera.width, camera.height, camera.K, pose).project(points)[0]
