"""Bodies from rigs and from the shipped parametric model; refusals of broken ones."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import default_body, make_body
from evsplat.body.make import shape_like
from evsplat.body.tree import joint_depths, tree_levels
from evsplat.errors import DataError

from .helpers import random_rig


def test_default_body_is_a_person_and_follows_its_shape_directions():
    body = default_body()
    low, high = body.rest_vertices.amin(0), body.rest_vertices.amax(0)
    assert 1.5 < (high - low)[2] < 2.0 and body.weights.shape == (13_718, 31)
    assert (body.weights.sum(1) - 1).abs().max() < 1e-6
    plus, minus = default_body(np.array([2.0])), default_body(np.array([-2.0]))
    assert (plus.rest_vertices - minus.rest_vertices).norm(dim=-1).mean() > 0.02
    middle = 0.5 * (plus.rest_vertices + minus.rest_vertices)
    assert torch.allclose(middle, body.rest_vertices, atol=1e-5)  # linear in betas
    assert torch.allclose(0.5 * (plus.rest_joints + minus.rest_joints), body.rest_joints, atol=1e-5)


def lengths(joints: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Upper arms, forearms, shins and the breadth between the shoulders, metres."""
    at = dict(zip(names, joints, strict=True))
    bones = [("Arm", "ForeArm"), ("ForeArm", "Hand"), ("Leg", "Foot")]
    pairs = [(f"{side}{a}", f"{side}{b}") for a, b in bones for side in ("Left", "Right")]
    pairs.append(("LeftArm", "RightArm"))
    return np.array([np.linalg.norm(at[a] - at[b]) for a, b in pairs])


@pytest.mark.parametrize("seed", range(3))
def test_a_body_like_a_skeleton_has_its_lengths_wherever_it_stands_and_faces(seed):
    rng = np.random.default_rng(seed)
    shape = 1.5 * rng.normal(size=10)
    somebody, middling = default_body(shape), default_body()
    joints = somebody.rest_joints.double().numpy()
    turned = joints @ Rotation.random(rng=seed).as_matrix().T + rng.normal(size=3)
    found = shape_like(somebody.joint_names, somebody.parents.tolist(), turned)
    like = default_body(found)
    names = somebody.joint_names
    wanted, got, mean = (
        lengths(body.rest_joints.double().numpy(), names) for body in (somebody, like, middling)
    )
    # A coefficient costs as much as a centimetre of one length.
    assert np.abs(got - wanted).mean() < 0.4 * np.abs(mean - wanted).mean()
    assert np.linalg.norm(found) <= np.linalg.norm(shape)


def test_too_many_betas_are_refused():
    with pytest.raises(DataError, match="11 shape coefficients, but the body has 10"):
        default_body(np.zeros(11))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"parents": np.array([-1, 0, -1, 2])}, "2 roots"),
        ({"parents": np.array([1, 0, 1, 2])}, "0 roots"),
        ({"parents": np.array([-1, 2, 3, 1])}, "cycle"),
        ({"parents": np.array([-1, 0, 9, 1])}, r"parents\[2\] is 9"),
        ({"faces": np.array([[0, 1, 60]])}, r"vertex indices in 0\.\.59"),
        ({"faces": np.zeros((0, 3), int)}, "at least one triangle"),
        ({"weights": np.zeros((60, 4))}, "every vertex needs a joint"),
        ({"weights": np.ones((60, 3))}, r"weights has shape \(60, 3\), expected \(60, 4\)"),
        ({"rest_joints": np.full((4, 3), np.inf)}, "rest_joints holds values that are not finite"),
        ({"joint_names": ("a", "b")}, "joint_names has shape"),
    ],
)
def test_broken_rigs_are_refused_by_name(change, message):
    rig = {**random_rig(0, joints=4), **change}
    with pytest.raises(DataError, match=message):
        make_body(**rig)


def test_weights_are_brought_to_one():
    rig = random_rig(1)
    body, _ = make_body(**{**rig, "weights": 3 * rig["weights"]})
    assert (body.weights.sum(1) - 1).abs().max() < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_levels_hold_every_joint_once_below_its_parent(seed):
    parents = random_rig(seed, joints=23, shuffled=True)["parents"].tolist()
    levels = tree_levels(parents)
    assert sorted(torch.cat([level.joints for level in levels]).tolist()) == list(range(23))
    depths = joint_depths(parents)
    for depth, level in enumerate(levels):
        assert all(depths[joint] == depth for joint in level.joints.tolist())
        if depth:
            above = levels[depth - 1].joints[level.parent_slots].tolist()
            assert above == [parents[joint] for joint in level.joints.tolist()]
