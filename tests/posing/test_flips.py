"""Limbs turned over in depth: what a mirror image keeps, and that the right one is found."""

import pytest
import torch
from tests.posing.moving import CAMERA, SPAN_US, landmarks

from evsplat.posing.fit import FitSettings, fit_landmarks
from evsplat.posing.flips import _smallest_turns, _Stretch, _turned_over, settle_flips
from evsplat.posing.kinematics import pose
from evsplat.posing.rig import default_rig

SETTINGS = FitSettings(height_m=default_rig().stature, knot_s=0.08)


PART, END = "left_forearm", "left_hand"
"""A bone of the motion that points 0.2 m towards the camera, and where it ends."""


@pytest.fixture(scope="module")
def fit():
    marks = landmarks(12)
    cameras = [CAMERA] * len(marks)
    return fit_landmarks(marks, cameras, SPAN_US, settings=SETTINGS, flips=False)


def posed(problem, state):
    return pose(problem.rig, problem.grid.of(state.control), state.betas)


def bone(problem, state) -> torch.Tensor:
    joints = posed(problem, state).joints
    return joints[:, problem.rig.joint(END)] - joints[:, problem.rig.joint(PART)]


def depth(problem, state) -> torch.Tensor:
    away = problem.away(posed(problem, state))
    return (bone(problem, state) * away).sum(-1)


def test_a_bone_turned_over_is_its_mirror_image_in_depth_for_a_while(fit):
    problem, state = fit.problem, fit.state
    count = len(problem.grid_s)
    first, last = count // 4, 3 * count // 4
    other = _turned_over(problem, state, _Stretch(PART, False, first, last))
    before, after = bone(problem, state), bone(problem, other)
    away = problem.away(posed(problem, state))
    mirrored = before - 2 * depth(problem, state)[:, None] * away
    # At its ends the curves take a few times of the grid.
    inside = slice(first + 5, last - 4)
    torch.testing.assert_close(after[inside], mirrored[inside], atol=0.02, rtol=0)
    assert (after - before)[inside].norm(dim=-1).min() > 0.3
    for outside in (slice(0, first - 4), slice(last + 5, None)):
        torch.testing.assert_close(after[outside], before[outside], atol=0.02, rtol=0)
    # What follows the bone keeps its direction in the world, what is not below it all.
    hand = problem.rig.joint(END)
    turns = [posed(problem, each).turned[inside, hand] for each in (state, other)]
    torch.testing.assert_close(turns[1], turns[0], atol=0.05, rtol=0)
    elbow = problem.rig.joint(PART)
    places = [posed(problem, each).joints[:, elbow] for each in (state, other)]
    torch.testing.assert_close(places[1], places[0], atol=1e-9, rtol=0)


def test_a_limb_that_points_the_wrong_way_is_turned_back_where_depths_are_told(fit):
    problem, state = fit.problem, fit.state
    whole = _Stretch(PART, False, 0, len(problem.grid_s) - 1)
    wrong = _turned_over(problem, state, whole)
    assert float(depth(problem, state).max()) < -0.1 and float(depth(problem, wrong).min()) > 0.1
    price = problem.price(wrong)
    found, found_price, doubts = settle_flips(problem, wrong, price)
    assert found_price == pytest.approx(problem.price(found))
    assert found_price < 1.05 * problem.price(state) < price
    torch.testing.assert_close(depth(problem, found), depth(problem, state), atol=0.05, rtol=0)
    assert PART not in [doubt.part for doubt in doubts]


@pytest.mark.parametrize("seed", range(3))
def test_turns_are_the_smallest_from_one_direction_to_the_other(seed):
    generator = torch.Generator().manual_seed(seed)
    start, end = torch.randn(2, 20, 3, generator=generator, dtype=torch.float64)
    # Nearly opposite ones have no smallest turn.
    end = torch.where((start * end).sum(-1, keepdim=True) < 0, -end, end)
    turns = _smallest_turns(start, end)
    a, b = (torch.nn.functional.normalize(each, dim=-1) for each in (start, end))
    torch.testing.assert_close((turns @ a[..., None])[..., 0], b)
    angle = torch.acos(((turns.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    torch.testing.assert_close(angle, torch.acos((a * b).sum(-1)))
