from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import axis_angle_to_matrix
from evsplat.body.retarget import COLLAR_SHARE, rest_from_zero, retarget, smallest_rotation
from evsplat.body.rotations import nearest_axis_angle
from evsplat.body.skeleton import find_skeleton
from evsplat.errors import DataError

from .helpers import posed_joints
from .skeletons import (
    ACCLAIM,
    DEEPMIMIC,
    SMPL,
    Y_UP_FACING_X,
    Y_UP_FACING_Z,
    one_joint_turning,
    random_motion,
    tables,
    world_turns,
)

SOURCES = {"smpl": SMPL, "deepmimic": DEEPMIMIC, "acclaim": ACCLAIM}
BONES = [
    (part, end)
    for part, end in (
        ("upper_arm", "forearm"),
        ("forearm", "hand"),
        ("thigh", "shin"),
        ("shin", "foot"),
    )
]


def own_skeleton(body):
    return body.joint_names, body.parents.numpy(), body.rest_joints.double().numpy()


def directions(joints, skeleton):
    pairs = [
        (skeleton.limbs[f"{s}_{a}"], skeleton.limbs[f"{s}_{b}"])
        for s in ("left", "right")
        for a, b in BONES
    ]
    bones = np.stack([joints[:, b] - joints[:, a] for a, b in pairs], 1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


@pytest.mark.parametrize("seed", range(3))
def test_onto_the_same_skeleton_is_the_identity(body, seed):
    motion, vectors = random_motion(*own_skeleton(body), seed)
    poses, transl = retarget(motion, body)
    back = (
        Rotation.from_rotvec(poses.reshape(-1, 3))
        * Rotation.from_rotvec(vectors.reshape(-1, 3)).inv()
    )
    assert back.magnitude().max() < 1e-7
    assert np.abs(transl - (motion.root_positions - motion.zero_joints[0])).max() < 1e-6
    assert np.abs(posed_joints(body, poses, transl) - motion.joints()).max() < 1e-6


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("axes", [np.eye(3), Y_UP_FACING_Z], ids=["world", "turned"])
@pytest.mark.parametrize("name", SOURCES)
def test_arms_and_legs_point_where_the_source_has_them(body, name, axes, seed):
    motion, _ = random_motion(*tables(SOURCES[name]), seed, axes=axes)
    poses, transl = retarget(motion, body)
    mover = find_skeleton(motion.parents.tolist(), motion.joint_names)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    got = directions(posed_joints(body, poses, transl), taker)
    assert np.abs(got - directions(motion.joints(), mover)).max() < 1e-6


@pytest.mark.parametrize("name", SOURCES)
def test_the_midpoint_of_the_hips_is_the_sources_times_the_ratio_of_legs(body, name):
    motion, _ = random_motion(*tables(SOURCES[name]), seed=3)
    mover = find_skeleton(motion.parents.tolist(), motion.joint_names)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    middle = [skeleton.limbs["left_thigh"] for skeleton in (mover, taker)]
    other = [skeleton.limbs["right_thigh"] for skeleton in (mover, taker)]
    there = motion.joints()[:, [middle[0], other[0]]].mean(1)
    for scale in (None, 1.0):
        placed = posed_joints(body, *retarget(motion, body, root_scale=scale))
        here = placed[:, [middle[1], other[1]]].mean(1)
        share = (here * there).sum() / (there * there).sum()
        assert np.abs(here - share * there).max() < 1e-6
        assert abs(share - 1) < 1e-6 if scale else 0.9 < share < 1.3


def test_a_body_twice_as_large_moves_twice_as_far(body):
    motion, vectors = random_motion(*own_skeleton(body), seed=4)
    half = replace(
        motion, zero_joints=motion.zero_joints / 2, root_positions=motion.root_positions / 2
    )
    assert np.allclose(retarget(half, body)[1], retarget(motion, body)[1], atol=1e-9)
    assert np.allclose(retarget(half, body)[0], retarget(motion, body)[0], atol=1e-9)


def test_a_raised_arm_stays_raised_and_the_zero_pose_stands_upright(body):
    motion = one_joint_turning(SMPL, "left_shoulder", [[0, 0, 0], [0, 0, np.pi / 2]], Y_UP_FACING_Z)
    poses, transl = retarget(motion, body)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    placed = posed_joints(body, poses, transl)
    arm = placed[:, taker.limbs["left_hand"]] - placed[:, taker.limbs["left_upper_arm"]]
    arm /= np.linalg.norm(arm, axis=1, keepdims=True)
    assert arm[0] @ [1, 0, 0] > 0.99  # the T-pose: to the person's left
    assert arm[1] @ [0, 0, 1] > 0.99
    trunk = [*taker.spine, *taker.neck, 0]
    assert np.abs(poses[0][trunk]).max() < 1e-9
    head = placed[0, taker.neck[-1]]
    assert head[2] - placed[0, 0, 2] > 0.5 and abs(head[0] - placed[0, 0, 0]) < 1e-3


def test_a_bend_of_the_trunk_is_spread_evenly_over_the_spine(body):
    motion = one_joint_turning(DEEPMIMIC, "chest", [[0, 0, -0.6]], Y_UP_FACING_X)  # forward
    poses, _ = retarget(motion, body)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    for joint in taker.spine:
        assert np.allclose(poses[0, joint], [0.2, 0, 0], atol=1e-9)
    for joint in taker.neck:
        assert np.allclose(poses[0, joint], 0, atol=1e-9)


def test_without_collar_bones_they_follow_the_arm_a_little_and_never_jump(body):
    angles = np.linspace(0, 2 * np.pi, 721)
    turning = angles[:, None] * [0, 0, 1.0]
    motion = one_joint_turning(DEEPMIMIC, "left_shoulder", turning, Y_UP_FACING_X)
    poses, _ = retarget(motion, body)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    collar = poses[:, taker.limbs["left_collar"]]
    size = np.linalg.norm(collar, axis=1)
    assert np.allclose(size[: 720 // 3], COLLAR_SHARE * angles[: 720 // 3], atol=1e-9)
    # half a degree of the arm per step; an unfaded share would jump by 0.75 at half a turn
    assert np.abs(np.diff(poses, axis=0)).max() < 0.1


def test_the_floor_lift_puts_the_lowest_vertex_at_zero(body):
    motion, _ = random_motion(*tables(SMPL), seed=5, times=1, axes=Y_UP_FACING_Z)
    poses, transl = retarget(motion, body, floor_up=(0.0, 0.0, 1.0))
    bones = body.bone_transforms(
        axis_angle_to_matrix(torch.from_numpy(poses)).float(), torch.from_numpy(transl).float()
    )
    homogeneous = torch.nn.functional.pad(body.rest_vertices, (0, 1), value=1.0)
    per_bone = torch.einsum("jab,vb->vja", bones[0], homogeneous)[..., :3]
    moved = (per_bone * body.weights[:, :, None]).sum(1)
    assert abs(moved[:, 2].min().item()) < 1e-5
    plain = retarget(motion, body)[1]
    assert np.abs((transl - plain)[:, :2]).max() == 0


def test_a_joint_map_overrides_what_would_be_guessed(body):
    motion, _ = random_motion(*tables(SMPL), seed=6)
    given = {"LeftHand": "pelvis"}
    poses, _ = retarget(motion, body, joint_map=given)
    world = world_turns(body.parents.numpy(), axis_angle_to_matrix(torch.from_numpy(poses)).numpy())
    hand, hips = body.joint_names.index("LeftHand"), 0
    relative = Rotation.from_matrix(world[:, hips].swapaxes(-1, -2) @ world[:, hand])
    assert np.ptp(relative.as_rotvec(), axis=0).max() < 1e-7  # rigid with the pelvis
    with pytest.raises(DataError, match="joint_map names 'tail', which is none of Hips"):
        retarget(motion, body, joint_map={"tail": "pelvis"})


def test_every_rig_is_matched_with_any_order_of_joints(body):
    names, parents, joints = tables(ACCLAIM)
    skeleton = find_skeleton(parents.tolist(), names)
    named = {part: names[joint] for part, joint in skeleton.limbs.items() if "left" in part}
    assert named == {
        "left_thigh": "lfemur",
        "left_shin": "ltibia",
        "left_foot": "lfoot",
        "left_toe": "ltoes",
        "left_collar": "lclavicle",
        "left_upper_arm": "lhumerus",
        "left_forearm": "lradius",
        "left_hand": "lhand",
    }
    assert [names[j] for j in skeleton.spine] == ["lowerback", "upperback", "thorax"]
    assert [names[j] for j in skeleton.neck] == ["lowerneck", "upperneck", "head"]
    own = find_skeleton(body.parents.tolist(), body.joint_names)
    named = {part: body.joint_names[j] for part, j in own.limbs.items() if "right" in part}
    assert named == {
        "right_thigh": "RightUpLeg",
        "right_shin": "RightLeg",
        "right_foot": "RightFoot",
        "right_toe": "RightToeBase",
        "right_collar": "RightShoulder",
        "right_upper_arm": "RightArm",
        "right_forearm": "RightForeArm",
        "right_hand": "RightHand",
    }
    order = np.random.default_rng(0).permutation(len(names))
    slot = np.argsort(order)
    motion, _ = random_motion(names, parents, joints, seed=7)
    shuffled = replace(
        motion,
        joint_names=tuple(names[j] for j in order),
        parents=np.where(parents[order] < 0, -1, slot[parents[order]]),
        zero_joints=joints[order],
        world_rotations=motion.world_rotations[:, order],
    )
    for got, expected in zip(retarget(shuffled, body), retarget(motion, body), strict=True):
        assert np.array_equal(got, expected)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("upperarm_l lowerarm_l hand_l clavicle_l thigh_l calf_l foot_l ball_l",
         "upper_arm forearm hand collar thigh shin foot toe"),
        ("mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand mixamorig:LeftShoulder "
         "mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase",
         "upper_arm forearm hand collar thigh shin foot toe"),
        ("LeftUpperArm LeftLowerArm LeftHand LeftShoulder LeftUpperLeg LeftLowerLeg LeftFoot "
         "LeftToes", "upper_arm forearm hand collar thigh shin foot toe"),
        ("upperarm01.L lowerarm01.L wrist.L clavicle.L upperleg01.L lowerleg01.L foot.L toe1-1.L",
         "upper_arm forearm hand collar thigh shin foot toe"),
    ],
)  # fmt: skip
def test_names_of_common_rigs(names, expected):
    left = names.split()
    right = [n.replace("Left", "Right").replace("_l", "_r").replace(".L", ".R") for n in left]
    all_names = ["hips", "spine", *left, *right]
    one = {"collar": 1, "upper_arm": "collar", "forearm": "upper_arm", "hand": "forearm",
           "thigh": 0, "shin": "thigh", "foot": "shin", "toe": "foot"}  # fmt: skip
    parts = expected.split()
    parents = [-1, 0]
    for first in (2, 2 + len(left)):
        parents += [up if isinstance(up := one[p], int) else first + parts.index(up) for p in parts]
    skeleton = find_skeleton(parents, all_names)
    assert skeleton.limbs == {
        f"{side}_{part}": 2 + offset + index
        for side, offset in (("left", 0), ("right", len(left)))
        for index, part in enumerate(parts)
    }
    assert skeleton.spine == (1,)


def test_the_elbow_bends_to_the_zero_pose_without_a_twist(body):
    poses, _ = retarget(one_joint_turning(SMPL, "pelvis", np.zeros((1, 3)), np.eye(3)), body)
    rest = body.rest_joints.double().numpy()
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    for side in ("left", "right"):
        for above, part, end in (("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot")):
            a, b, c = (taker.limbs[f"{side}_{name}"] for name in (above, part, end))
            assert abs(poses[0, b] @ (rest[c] - rest[b])) < 1e-9
            assert np.abs(poses[0, c]).max() < 1e-9 or part == "shin"


def test_unknown_limbs_and_wrong_shapes_are_named(body):
    names, parents, joints = tables(SMPL)
    motion, _ = random_motion(names, parents, joints, seed=0)
    with pytest.raises(DataError, match="no joint recognised as left_forearm among pelvis"):
        retarget(
            replace(
                motion, joint_names=tuple("left_thing" if n == "left_elbow" else n for n in names)
            ),
            body,
        )
    with pytest.raises(DataError, match=r"root_positions has shape \(5, 2\), expected \(5, 3\)"):
        retarget(replace(motion, root_positions=motion.root_positions[:, :2]), body)
    with pytest.raises(DataError, match="world_rotations holds matrices that are no rotations"):
        retarget(replace(motion, world_rotations=1.1 * motion.world_rotations), body)
    with pytest.raises(DataError, match="world_from_source holds matrices that are no rotations"):
        retarget(replace(motion, world_from_source=np.diag([1.0, 1, -1])), body)
    broken = motion.world_rotations.copy()
    broken[0, 3, 0, 0] = np.nan
    with pytest.raises(DataError, match="world_rotations holds values that are not finite"):
        retarget(replace(motion, world_rotations=broken), body)


@pytest.mark.parametrize("seed", range(3))
def test_the_smallest_rotation_turns_one_into_the_other_about_their_common_normal(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3))
    turn = smallest_rotation(a, b)
    assert np.allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-12)
    vector = Rotation.from_matrix(turn).as_rotvec()
    assert abs(vector @ a) < 1e-9 and abs(vector @ b) < 1e-9
    assert np.allclose(smallest_rotation(a, -a) @ a, -a, atol=1e-9)
    assert np.allclose(smallest_rotation(a, 2 * a), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_vectors_follow_each_other_and_mean_the_same_rotations(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = np.linspace(-4.0, 9.0, 200)
    smooth = angle[:, None, None] * axis
    written = Rotation.from_rotvec(smooth[:, 0]).as_rotvec()[:, None]
    assert np.abs(np.diff(written, axis=0)).max() > 1  # the tool's own vectors do jump
    found = nearest_axis_angle(written)
    assert np.allclose(found - smooth, (found - smooth)[0], atol=1e-9)
    turns = ((found - smooth)[0] @ axis) / (2 * np.pi)
    assert np.allclose(turns, np.round(turns), atol=1e-9)
    same = Rotation.from_rotvec(found[:, 0]) * Rotation.from_rotvec(written[:, 0]).inv()
    assert same.magnitude().max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_between_poses_that_lie_askew_the_whole_turn_is_found_and_nothing_is_stretched(seed):
    names, parents, joints = tables(SMPL)
    skeleton = find_skeleton(parents.tolist(), names)
    rng = np.random.default_rng(seed)
    # From no axis to any other by less than 35 degrees.
    turn = Rotation.from_rotvec(np.radians(45) * np.eye(3)[seed]).as_matrix()
    turn = turn @ Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix()
    found = rest_from_zero(skeleton, joints, skeleton, joints @ turn.T)
    np.testing.assert_allclose(found, turn, atol=1e-9)
    # What differs by a few degrees only is taken as drawn along axes.
    lean = Rotation.from_rotvec([np.radians(9), 0, 0]).as_matrix()
    np.testing.assert_allclose(
        rest_from_zero(skeleton, joints, skeleton, joints @ lean.T), np.eye(3)
    )
