"""Pose sliders move limbs where their labels say."""

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack
from evsplat.body.skeleton import find_skeleton
from evsplat.view.posing import HeldPose, pose_sliders, turned

UP, LEFT, AHEAD = np.eye(3)[2], np.eye(3)[0], -np.eye(3)[1]
"""Of the body that ships: z up, facing -y, its left at +x."""


def _joints(body, rotations):
    frames = body.joint_transforms(rotations, torch.zeros(3))
    return frames[:, :3, 3].numpy()


def _moved(body, group, label, degrees, start=None):
    """Change of every joint's place by one slider."""
    sliders = pose_sliders(body)
    angles = tuple(degrees if (s.group, s.label) == (group, label) else 0.0 for s in sliders)
    assert any(angles)
    rest = torch.eye(3).repeat(len(body.parents), 1, 1) if start is None else start
    return _joints(body, turned(sliders, angles, rest)) - _joints(body, rest)


@pytest.mark.parametrize(
    ("group", "label", "limb", "direction"),
    [
        ("Torso", "forward", "left_upper_arm", AHEAD),
        ("Torso", "to the left", "left_upper_arm", LEFT),
        ("Torso", "turn left", "right_upper_arm", AHEAD),
        ("Left arm", "outward", "left_hand", UP),
        ("Right arm", "outward", "right_hand", UP),
        ("Left arm", "bend", "left_hand", AHEAD),
        ("Right arm", "bend", "right_hand", AHEAD),
        ("Left leg", "forward", "left_foot", AHEAD),
        ("Right leg", "forward", "right_foot", AHEAD),
        ("Left leg", "outward", "left_foot", LEFT),
        ("Right leg", "outward", "right_foot", -LEFT),
        ("Left leg", "bend", "left_foot", -AHEAD),
        ("Right leg", "bend", "right_foot", -AHEAD),
    ],
)
def test_a_slider_moves_its_limb_as_it_says(body, group, label, limb, direction):
    joint = find_skeleton(body.parents.tolist(), body.joint_names).limbs[limb]
    change = _moved(body, group, label, 20.0)[joint]
    assert change @ direction > 0.02
    # Limbs move on arcs and do not begin across them.
    assert change @ direction > 0.5 * np.linalg.norm(change)


@pytest.mark.parametrize("seed", range(3))
def test_bending_an_elbow_by_the_slider_changes_its_angle_by_as_much_in_any_pose(body, seed):
    limbs = find_skeleton(body.parents.tolist(), body.joint_names).limbs
    shoulder, elbow, hand = (limbs[f"left_{p}"] for p in ("upper_arm", "forearm", "hand"))
    generator = torch.Generator().manual_seed(seed)
    rotations = torch.linalg.qr(torch.randn(len(body.parents), 3, 3, generator=generator))[0]
    rotations = rotations * rotations.det()[:, None, None]
    rotations[elbow] = torch.eye(3)
    still = _joints(body, rotations)
    bent = still + _moved(body, "Left arm", "bend", 50.0, rotations)
    fore = [joints[hand] - joints[elbow] for joints in (still, bent)]
    cosine = fore[0] @ fore[1] / np.prod([np.linalg.norm(bone) for bone in fore])
    assert np.degrees(np.arccos(cosine)) == pytest.approx(50, abs=0.1)
    assert np.allclose(still[shoulder], bent[shoulder])


def test_sliders_at_zero_leave_the_pose(body):
    sliders = pose_sliders(body)
    rotations = torch.randn(len(body.parents), 3, 3)
    assert torch.equal(turned(sliders, (0.0,) * len(sliders), rotations), rotations)


def test_a_held_pose_stands_at_all_times_in_copies_too(body):
    joints = len(body.parents)
    track = BodyTrack(body, np.array([0, 10]), np.full((2, joints, 3), 0.1), np.zeros((2, 3)))
    held = HeldPose(track)
    moved = held.to("cpu")
    rotations, transl = torch.randn(1, joints, 3, 3), torch.randn(1, 3)
    held.hold(rotations, transl)
    for instant in ([0], [5, 99_999]):
        found = moved.at(instant)
        assert torch.equal(found[0], rotations.expand(len(instant), -1, -1, -1))
        assert torch.equal(found[1], transl.expand(len(instant), -1))
