"""Rigs of other bodies move as the body that ships would."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.posing.moving import CAMERA, motion, stick_figure

from evsplat.body import BodyTrack, default_body
from evsplat.body.rotations import axis_angle_to_matrix, six_to_matrix
from evsplat.errors import DataError
from evsplat.landmarks import BLAZEPOSE_33, COCO_17, OPENPOSE_25
from evsplat.posing.kinematics import PLACE, SIX, TURNS, Points, pose
from evsplat.posing.prior import ROWS, mirrored, pose_prior
from evsplat.posing.rig import attach, blazepose_offsets, default_rig, make_rig

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import learn_posing  # noqa: E402


def test_the_body_that_ships_keeps_its_own_frames():
    frames = default_rig().frames
    torch.testing.assert_close(frames, torch.eye(3, dtype=torch.float64).expand_as(frames))


def test_bones_of_another_body_point_where_those_of_the_shipped_one_do():
    generator = torch.Generator().manual_seed(0)
    rows = 0.5 * torch.randn(2, len(ROWS), 3, generator=generator, dtype=torch.float64)
    root = axis_angle_to_matrix(torch.randn(2, 3, generator=generator, dtype=torch.float64))
    directions = []
    for rig in (default_rig(), make_rig(stick_figure, "smpl", 1)):
        poses = torch.from_numpy(rig.poses(root, rows))
        body = rig.body(np.zeros(len(rig.growth)))
        places = body.joint_transforms(axis_angle_to_matrix(poses), torch.zeros(2, 3).double())
        limbs = [
            places[:, rig.joint(f"{side}_{end}"), :3, 3]
            - places[:, rig.joint(f"{side}_{part}"), :3, 3]
            for part, end in (("upper_arm", "forearm"), ("forearm", "hand"),
                              ("thigh", "shin"), ("shin", "foot"))
            for side in ("left", "right")
        ]  # fmt: skip
        directions.append(torch.nn.functional.normalize(torch.stack(limbs), dim=-1))
    torch.testing.assert_close(*directions, rtol=0, atol=1e-5)


def test_stature_follows_the_coefficients():
    rig = default_rig()
    betas = np.array([1.0, -0.5, 0, 0, 0, 0, 0, 0, 0, 0])
    vertices = default_body(betas).rest_vertices[:, 2].double()
    expected = float(vertices.max() - vertices.min())
    assert rig.stature + float(rig.growth @ torch.from_numpy(betas)) == pytest.approx(
        expected, abs=2e-3
    )


@pytest.mark.parametrize("wide", [1.0, 1.7, 2.5])
def test_stature_is_the_way_up_however_far_the_arms_reach(wide):
    def held_out(betas):
        body, wider = default_body(np.pad(betas, (0, 8))), torch.tensor([wide, 1.0, 1.0])
        vertices, joints = body.rest_vertices * wider, body.rest_joints * wider
        return replace(body, rest_vertices=vertices, rest_joints=joints)

    rig, plain = make_rig(held_out, "smpl", 2), default_rig()
    assert rig.stature == pytest.approx(plain.stature)
    torch.testing.assert_close(rig.growth, plain.growth[:2])


@pytest.mark.parametrize(("names", "least"), [(BLAZEPOSE_33, 33), (COCO_17, 17), (OPENPOSE_25, 23)])
def test_all_usual_sets_of_key_points_sit_on_the_rig(names, least):
    assert len(attach(default_rig(), names).index) >= least


def test_unknown_key_points_are_one_sentence():
    with pytest.raises(DataError, match="expected at least 8"):
        attach(default_rig(), [f"point_{i}" for i in range(17)])


def test_mirroring_twice_changes_nothing():
    rows = np.random.default_rng(0).normal(size=(3, len(ROWS), 3))
    np.testing.assert_array_equal(mirrored(mirrored(rows)), rows)


def test_a_motion_can_be_left_out_of_the_prior():
    whole, without = pose_prior(), pose_prior(without=("dance_b",))
    assert not torch.equal(whole.mean, without.mean)
    assert torch.linalg.eigvalsh(without.precision).min() > 0
    with pytest.raises(DataError, match="no motion is named 'waltz'"):
        pose_prior(without=("waltz",))


def test_offsets_are_learned_back_from_landmarks_that_lie_at_them():
    """Somebody from the front and from the left; offsets a millimetre or two from given ones."""
    rig, times = default_rig(), np.arange(0, 800_000, 50_000)
    vectors = motion(times)
    poses = rig.poses(six_to_matrix(vectors[:, SIX]), vectors[:, TURNS].unflatten(1, (-1, 3)))
    body = default_body()
    transl = vectors[:, PLACE].numpy() - body.rest_joints[0].double().numpy()
    track = BodyTrack(body, times, poses, transl)
    attached = attach(rig, BLAZEPOSE_33)
    points = Points(attached.origin, attached.turner, attached.offset)
    places = points.of(pose(rig, vectors, torch.zeros(10, dtype=torch.float64)))
    left = torch.tensor([[0.0, 1, 0, 0], [0, 0, -1, 0.2], [-1, 0, 0, 3.5], [0, 0, 0, 1]])
    data = []
    for camera in (CAMERA, replace(CAMERA, world_to_camera=left)):
        pixels = camera.project(places)[0].numpy()
        seen = np.ones(pixels.shape[:2])
        data.append(learn_posing.residuals_of(track, camera, times, pixels, seen, BLAZEPOSE_33))
    learned = learn_posing.offsets_of(data)
    for name, (origin, turner, offset) in blazepose_offsets().items():
        assert learned[name][:2] == [origin, turner]
        assert learned[name][2] == pytest.approx(offset, abs=2e-3), name
