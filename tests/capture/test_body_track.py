"""Bodies and tracks from body.npz, and the spline's error between real key poses."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from evsplat.body import default_body, skin, up_axis
from evsplat.body.smpl import ENVIRONMENT
from evsplat.capture import BodyFile, load_body_track, load_capture
from evsplat.capture.body_track import load_body
from evsplat.errors import DataError
from evsplat.inspection import inspect_capture

from ..body.helpers import random_rig, reference_bones, reference_skin
from ..body.test_smpl import smpl_like


def body_file(model="rig", times_us=(), poses=(), transl=(), **arrays):
    return BodyFile(Path("body.npz"), model, times_us, poses, transl, **arrays)


def test_default_model_of_a_file_is_the_default_body():
    betas = np.array([0.5, -1.0])
    body, order = load_body(body_file(model="default", betas=betas))
    assert torch.equal(body.rest_vertices, default_body(betas).rest_vertices)
    assert order == list(range(31))


def test_smpl_of_a_file_is_found_where_the_environment_says(tmp_path, monkeypatch):
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **smpl_like())
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    body, order = load_body(body_file(model="smpl", betas=np.ones(10)))
    assert order == list(range(24)) and body.joint_names[1] == "left_hip"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"rest_vertices": None}, "rest_vertices is missing"),
        (
            {"weights": np.ones((60, 3))},
            r"body.npz: weights has shape \(60, 3\), ",
        ),
        ({"model": "stickman"}, "model is 'stickman', expected one of"),
    ],
)
def test_broken_bodies_are_refused_by_name(change, message):
    with pytest.raises(DataError, match=message):
        load_body(body_file(**{**random_rig(0, joints=4), **change}))


@pytest.mark.parametrize("bad", [[0, 0, 0], [0, 1], "z", [0, float("nan"), 1]])
def test_a_direction_that_cannot_be_up_is_named(tiny_capture, bad):
    path = tiny_capture()
    write_up(path, bad)
    with pytest.raises(DataError, match=r"capture\.json: up: found .*, expected"):
        load_capture(path)


def test_what_is_up_is_not_told_where_the_capture_does_not_say(tiny_capture, tmp_path):
    assert "\nup  " not in inspect_capture(tiny_capture(), tmp_path / "out").summary


@pytest.mark.parametrize("axis", range(3))
def test_what_a_capture_says_is_up_is_up_and_told(tiny_capture, tmp_path, axis):
    path = tiny_capture()
    said = np.full(3, 0.2)
    said[axis] = -3.0
    write_up(path, said.tolist())
    assert up_axis(load_body_track(load_capture(path))).tolist() == (-np.eye(3)[axis]).tolist()
    summary = inspect_capture(path, tmp_path / "out").summary
    assert f"\nup         -{'xyz'[axis]}, as capture.json says\n" in summary


def write_up(path, value):
    document = json.loads((path / "capture.json").read_text())
    (path / "capture.json").write_text(json.dumps(document | {"up": value}))


def test_unsorted_joints_and_their_poses_move_together():
    rig = random_rig(4, joints=9, shuffled=True)
    rng = np.random.default_rng(4)
    poses, transl = rng.normal(size=(3, 9, 3)), rng.normal(size=(3, 3))
    times = np.array([0, 40_000, 80_000])
    errors = rng.random((3, 9)), rng.random((3, 3))
    stated = {"source": "markers", "pose_std_rad": errors[0], "transl_std_m": errors[1]}
    file = body_file(times_us=times, poses=poses, transl=transl, **rig, **stated)
    views = [torch.eye(4), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))]
    capture = SimpleNamespace(
        body_file=file,
        up=None,
        frames=[0, 1, 1, 1],
        camera=lambda frame: SimpleNamespace(world_to_camera=views[frame]),
    )
    track = load_body_track(capture)
    assert track.camera_up.tolist() == [0.0, 0.5, 0.0]
    order = load_body(file)[1]
    assert order != sorted(order)
    assert np.array_equal(track.errors.joint_rad, errors[0][:, order])
    assert np.array_equal(track.errors.root_m, errors[1]) and track.errors.source == "markers"
    moved, _ = skin(
        track.body.rest_vertices,
        track.body.weights,
        track.body.bone_transforms(*track.at([40_000])),
    )
    bones = reference_bones(rig["parents"], rig["rest_joints"], poses[1], transl[1])
    expected = reference_skin(rig["rest_vertices"], rig["weights"], bones)
    assert np.abs(moved[0].numpy() - expected).max() < 2e-5


def test_between_key_poses_of_a_dance_the_body_errs_by_millimetres(captures_root):
    """Interpolating 12.5 poses a second; body_dense.npz has the truth in between."""
    capture = load_capture(captures_root / "man_dance_hard_256")
    track, truth = load_body_track(capture), load_body_track(capture, dense=True)
    times = np.arange(track.times_us[0], track.times_us[-1], 10_000)
    vertices, weights = track.body.canonical_vertices()[::20], track.body.weights[::20]
    error = (
        skin(vertices, weights, track.bones(times))[0]
        - skin(vertices, weights, truth.bones(times))[0]
    )
    mean_mm = 1e3 * error.norm(dim=-1).mean().item()
    assert mean_mm < 6.0  # measured 5.4: the spline's own error, not numerical
    slerp_mm = 1e3 * _piecewise_error(track, truth, times, vertices, weights)
    assert mean_mm < slerp_mm


def _piecewise_error(track, truth, times, vertices, weights):
    """The same with slerp and straight lines between neighbouring keys."""
    keys, transl = track.at(track.times_us)
    rotations = np.stack(
        [
            Slerp(track.times_us, Rotation.from_matrix(keys[:, joint].double().numpy()))(
                times
            ).as_matrix()
            for joint in range(keys.shape[1])
        ],
        1,
    )
    places = np.stack([np.interp(times, track.times_us, transl[:, axis]) for axis in range(3)], -1)
    bones = track.body.canonical_to_world(
        torch.tensor(rotations, dtype=torch.float32), torch.tensor(places, dtype=torch.float32)
    )
    truth_bones = truth.bones(times)
    error = skin(vertices, weights, bones)[0] - skin(vertices, weights, truth_bones)[0]
    return error.norm(dim=-1).mean().item()
