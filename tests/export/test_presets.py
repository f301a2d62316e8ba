"""Poses of the avatar's page point where their names say, on a body with limbs."""

import numpy as np
import pytest
import torch

from evsplat.body import up_axis
from evsplat.body.make import default_body
from evsplat.body.skeleton import find_skeleton
from evsplat.export.gaussians import rest_track
from evsplat.export.presets import joint_labels, presets
from evsplat.film import load_motion_of


@pytest.fixture(scope="module")
def track():
    return load_motion_of("kick", rest_track(default_body()))


def _placed(body, preset) -> np.ndarray:
    given = (torch.from_numpy(preset.rotations).float(), torch.from_numpy(preset.transl).float())
    placed = body.canonical_to_world(*given) @ body.canonical_bone_transforms()
    rest = torch.cat([body.rest_joints, torch.ones(len(body.parents), 1)], 1)
    return (placed @ rest[..., None])[:, :3, 0].double().numpy()


def test_arms_and_legs_point_where_the_pose_says(track):
    body, up = track.body, up_axis(track).double().numpy()
    limbs = find_skeleton(body.parents.tolist(), body.joint_names).limbs
    made = {preset.name: _placed(body, preset) for preset in presets(track, int(track.times_us[5]))}
    assert list(made) == ["Wave", "T", "Sit"]

    def bone(name: str, start: str, end: str) -> np.ndarray:
        vector = made[name][limbs[end]] - made[name][limbs[start]]
        return vector / np.linalg.norm(vector)

    for side in ("left", "right"):
        assert abs(bone("T", f"{side}_upper_arm", f"{side}_hand") @ up) < 0.02
        assert bone("T", f"{side}_thigh", f"{side}_foot") @ up < -0.99
        assert abs(bone("Sit", f"{side}_thigh", f"{side}_shin") @ up) < 0.1
        assert bone("Sit", f"{side}_shin", f"{side}_foot") @ up < -0.99
    assert bone("T", "left_upper_arm", "left_hand") @ bone("T", "right_upper_arm", "right_hand") < (
        -0.99
    )
    assert bone("Wave", "right_forearm", "right_hand") @ up > 0.9
    assert bone("Wave", "left_forearm", "left_hand") @ up < -0.9
    feet = [limbs["left_foot"], limbs["right_foot"]]
    heights = [min(joints[feet] @ up) for joints in made.values()]
    assert np.ptp(heights) < 0.02


def test_joints_have_the_names_that_people_use(track):
    labels = joint_labels(track.body)
    known = [label for label in labels if label is not None]
    assert {"Hips", "Head", "Left elbow", "Right knee", "Left shoulder"} <= set(known)
    assert len(set(known)) == len(known)


def test_a_body_without_limbs_keeps_its_names_and_has_no_poses(reconstruction):
    track = reconstruction[1].track
    assert joint_labels(track.body) == list(track.body.joint_names)
    assert presets(track, int(track.times_us[0])) == []
