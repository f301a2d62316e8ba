"""Finding legs in rigs of many names, and how far they are spread."""

import logging

import numpy as np
import pytest
import torch

from evsplat.body import default_body
from evsplat.body.canonical import SMPL_PARENTS, find_legs, leg_spread_rotations

NAMES = {
    "cmu": ("Hips", "LHipJoint", "LeftUpLeg", "LeftLeg", "RHipJoint", "RightUpLeg", "RightLeg"),
    "amc": ("root", "lhipjoint", "lfemur", "ltibia", "rhipjoint", "rfemur", "rtibia"),
    "mixamo": ("mixamorig:Hips", "x", "mixamorig:LeftUpLeg", "mixamorig:LeftLeg")
    + ("y", "mixamorig:RightUpLeg", "mixamorig:RightLeg"),
    "unreal": ("pelvis", "a", "thigh_l", "calf_l", "b", "thigh_r", "calf_r"),
    "vrm": ("J_Bip_C_Hips", "a", "J_Bip_L_UpperLeg", "J_Bip_L_LowerLeg")
    + ("b", "J_Bip_R_UpperLeg", "J_Bip_R_LowerLeg"),
    "makehuman": ("root", "pelvis.L", "upperleg01.L", "lowerleg01.L")
    + ("pelvis.R", "upperleg01.R", "lowerleg01.R"),
    "rigify": ("DEF-spine", "DEF-pelvis.L", "DEF-thigh.L", "DEF-shin.L")
    + ("DEF-pelvis.R", "DEF-thigh.R", "DEF-shin.R"),
    "biped": ("Bip01 Pelvis", "a", "Bip01 L Thigh", "Bip01 L Calf")
    + ("b", "Bip01 R Thigh", "Bip01 R Calf"),
    "h36m": ("Hip", "a", "LHip", "LKnee", "b", "RHip", "RKnee"),
}
PARENTS = (-1, 0, 1, 2, 0, 4, 5)


@pytest.mark.parametrize("rig", NAMES)
def test_thighs_of_common_rigs_are_found(rig):
    legs = find_legs(PARENTS, NAMES[rig])
    assert legs is not None and (legs.left, legs.right, legs.smpl) == (2, 5, False)


@pytest.mark.parametrize("named", [True, False])
def test_smpl_is_known_by_names_and_by_its_tree(named):
    names = [f"joint_{joint}" for joint in range(24)]
    if named:
        names[1:3] = "left_hip", "right_hip"
    legs = find_legs(SMPL_PARENTS, names)
    assert legs is not None and (legs.left, legs.right, legs.smpl) == (1, 2, True)


def test_smpl_legs_turn_45_degrees_about_z():
    """Method.md 1.2: left +45 degrees about z, right -45 (y up, z forward, left is +x)."""
    joints = torch.zeros(24, 3)
    joints[1], joints[2] = torch.tensor([0.06, -0.09, 0.0]), torch.tensor([-0.06, -0.09, 0.0])
    joints[4], joints[5] = torch.tensor([0.1, -0.47, 0.0]), torch.tensor([-0.1, -0.47, 0.0])
    rotations = leg_spread_rotations(SMPL_PARENTS, joints, [f"j{j}" for j in range(24)])
    c = np.sqrt(0.5)
    assert torch.allclose(rotations[1], torch.tensor([[c, -c, 0], [c, c, 0], [0, 0, 1]]).float())
    assert torch.allclose(rotations[2], rotations[1].T)
    others = [joint for joint in range(24) if joint not in (1, 2)]
    assert torch.equal(rotations[others], torch.eye(3).expand(22, 3, 3))


def test_default_body_stands_with_thighs_at_30_degrees_and_symmetric():
    body = default_body()
    bones = body.canonical_bone_transforms()
    joints = (bones[:, :3, :3] @ body.rest_joints[..., None])[..., 0] + bones[:, :3, 3]
    at = {name: joints[index] for index, name in enumerate(body.joint_names)}
    for side, sign in (("Left", 1), ("Right", -1)):
        thigh = at[f"{side}Leg"] - at[f"{side}UpLeg"]
        angle = torch.rad2deg(torch.atan2(sign * thigh[0], -thigh[2]))
        assert abs(angle.item() - 30) < 0.2  # y lean tilts the body's own "down" a little
    mirrored = at["RightToeBase"] * torch.tensor([-1.0, 1, 1])
    assert torch.allclose(at["LeftToeBase"], mirrored, atol=1e-3)


def test_legs_already_wide_stay_and_turning_the_whole_rig_turns_the_result():
    joints = torch.tensor(
        [[0, 0, 1], [0.1, 0, 1], [0.1, 0, 0.9], [0.6, 0, 0.4], [-0.1, 0, 1], [-0.1, 0, 0.9]]
        + [[-0.15, 0, 0.4]]
    )
    rotations = leg_spread_rotations(PARENTS, joints, NAMES["cmu"])
    assert torch.equal(rotations[2], torch.eye(3))  # 45 degrees out already
    assert (rotations[5] - torch.eye(3)).abs().max() > 0.1
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    turn = turn * torch.sign(torch.linalg.det(turn))
    turned = leg_spread_rotations(PARENTS, joints @ turn.T, NAMES["cmu"])
    assert torch.allclose(turned, turn @ rotations @ turn.T, atol=1e-6)


def test_a_rig_without_legs_keeps_its_rest_pose_and_says_so_once(caplog):
    rigs = [("base of this test", "arm", tip) for tip in ("tip", "tip", "claw")]
    with caplog.at_level(logging.WARNING):
        for names in rigs:
            rotations = leg_spread_rotations((-1, 0, 1), torch.rand(3, 3), names)
            assert torch.equal(rotations, torch.eye(3).expand(3, 3, 3))
    said = [message for message in caplog.messages if "No legs recognised" in message]
    assert len(said) == 2 and "claw" in said[1], "once for each rig, however often it is made"
