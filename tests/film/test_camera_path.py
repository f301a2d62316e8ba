"""Camera paths: closed forms of the ways around and between, and files that are wrong."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.capture import Camera
from evsplat.errors import DataError
from evsplat.film.camera_path import camera_path_document, read_camera_path, through


def _camera(seed: int) -> Camera:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    focal = rng.uniform(80, 120)
    K = torch.tensor([[focal, 0, 32.0], [0, focal, 24.0], [0, 0, 1]], dtype=torch.float32)
    return Camera(64, 48, K, torch.from_numpy(pose).float())


@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_way_passes_through_its_cameras(count):
    cameras = [_camera(seed) for seed in range(count)]
    shares = np.linspace(0, 1, count).tolist()
    path = through(shares, cameras)
    for share, camera in zip(shares, cameras, strict=True):
        at = path(share)
        torch.testing.assert_close(at.world_to_camera, camera.world_to_camera, atol=1e-5, rtol=0)
        torch.testing.assert_close(at.K, camera.K, atol=1e-4, rtol=0)


def test_cameras_of_other_sizes_are_seen_in_the_first_ones_pixels():
    camera = _camera(4)
    path = through([0, 0.5, 1], [camera, camera.resized(192, 96), camera.resized(32, 240)])
    for share in (0.0, 0.3, 0.5, 0.8, 1.0):
        at = path(share)
        assert (at.width, at.height) == (64, 48)
        torch.testing.assert_close(at.K, camera.K, atol=1e-3, rtol=0)


def test_two_cameras_have_a_straight_way_at_an_even_pace_and_several_a_smooth_one():
    ends = [_camera(seed) for seed in range(2)]
    path = through([0, 1], ends)
    first, last = (camera.center() for camera in ends)
    for share in (0.1, 0.25, 0.5, 0.9):
        center = torch.lerp(first, last, share)
        torch.testing.assert_close(path(share).center(), center, atol=1e-5, rtol=0)
    # Neither stands still at its ends nor turns a corner in the middle.
    shares = [0, 0.3, 1]
    path = through(shares, [_camera(seed) for seed in range(3)])
    step = 1e-2
    at = lambda share: path(share).center().double()  # noqa: E731
    for end, inward in ((0.0, step), (1.0, -step)):
        assert (at(end + inward) - at(end)).norm() > 0.5 * step
    before, after = at(0.3) - at(0.3 - step), at(0.3 + step) - at(0.3)
    assert (after - before).norm() < 0.2 * before.norm()


def _document() -> dict:
    return {
        "format": "evsplat-camera-path",
        "version": 1,
        "width": 64,
        "height": 48,
        "keys": [
            {
                "at": 0,
                "eye": [0, -3, 1],
                "target": [0, 0, 1],
                "up": [0, 0, 1],
                "fov_y_deg": 90,
            },
            {
                "at": 1,
                "world_to_camera": np.eye(4).tolist(),
                "K": [[50, 0, 30], [0, 60, 20], [0, 0, 1]],
            },
        ],
    }


def test_a_file_says_where_the_camera_looks(tmp_path):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(_document()))
    first, last = (read_camera_path(path)(share) for share in (0.0, 1.0))
    # A metre up at the target's distance of three is a third of the half height at 90 degrees.
    pixels, depth = first.project(torch.tensor([[0.0, 0, 1], [0, 0, 2], [1, 0, 1]]))
    expected = torch.tensor([[32.0, 24], [32, 16], [40, 24]])
    torch.testing.assert_close(pixels, expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, torch.full((3,), 3.0))
    torch.testing.assert_close(last.world_to_camera, torch.eye(4), atol=1e-6, rtol=0)
    assert last.K.tolist() == [[50, 0, 30], [0, 60, 20], [0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="other"), "format"),
        (lambda d: d.update(version=2), "version is 2"),
        (lambda d: d.update(width=0), "width, height"),
        (lambda d: d.update(keys=[]), "keys is empty"),
        (lambda d: d["keys"][0].pop("eye"), r"keys\[0\].eye is missing"),
        (lambda d: d["keys"][0].update(eye=[0, "x", 1]), r"keys\[0\].eye is"),
        (lambda d: d["keys"][0].update(up=[0, 1, 0]), "straight along up"),
        (lambda d: d["keys"][0].update(fov_y_deg=180), "fov_y_deg is 180"),
        (lambda d: d["keys"][1].update(at=0), "at is"),
        (lambda d: d["keys"][1].update(at=float("nan")), "at is"),
        (lambda d: d["keys"][1].update(K=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]), r"keys\[1\].K is"),
        (
            lambda d: d["keys"][1].update(world_to_camera=(2 * np.eye(4)).tolist()),
            "no rigid transform",
        ),
    ],
)
def test_wrong_files_name_file_and_field(tmp_path, change, message):
    document = _document()
    change(document)
    path = tmp_path / "path.json"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=message) as error:
        read_camera_path(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_cameras_come_back_from_the_file_written_of_them(tmp_path, count):
    cameras = [_camera(seed) for seed in range(count)]
    file = tmp_path / "path.json"
    file.write_text(json.dumps(camera_path_document(cameras)))
    path = read_camera_path(file)
    for share, camera in zip(np.linspace(0, 1, count), cameras, strict=True):
        back = path(share)
        torch.testing.assert_close(back.world_to_camera, camera.world_to_camera)
        torch.testing.assert_close(back.K, camera.K)


def test_key_frames_at_one_place_make_a_camera_that_stands(tmp_path):
    camera = _camera(0)
    file = tmp_path / "path.json"
    file.write_text(json.dumps(camera_path_document([camera] * 3)))
    back = read_camera_path(file)(0.3)
    torch.testing.assert_close(back.world_to_camera, camera.world_to_camera)
