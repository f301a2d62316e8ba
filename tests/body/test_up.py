"""Which way is up: told by all of the motion and by the cameras, not by one pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body, up_axis
from evsplat.inspection.summary import _up_lines

AXES = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]


def track_of(
    turns: list[Rotation], camera_up: np.ndarray | None = None, said: np.ndarray | None = None
) -> BodyTrack:
    """The body at rest under a turn of the root for each key."""
    body = default_body()
    times = np.arange(len(turns)) * 40_000
    poses = np.zeros((len(turns), len(body.parents), 3))
    poses[:, 0] = [turn.as_rotvec() for turn in turns]
    up = None if camera_up is None else torch.from_numpy(camera_up).float()
    given = None if said is None else torch.from_numpy(said).float()
    return BodyTrack(body, times, poses, np.zeros((len(turns), 3)), camera_up=up, up=given)


def standing(along: np.ndarray) -> Rotation:
    """The turn that puts the body at rest upright along an axis."""
    own = up_axis(track_of([Rotation.identity()])).double().numpy()
    return Rotation.align_vectors([along], [own])[0]


@pytest.mark.parametrize("up", AXES, ids=str)
def test_who_stands_along_an_axis_has_that_axis(up):
    assert up_axis(track_of([standing(up)] * 3)).tolist() == up.tolist()


@pytest.mark.parametrize("up", AXES, ids=str)
@pytest.mark.parametrize("seed", range(2))
def test_lying_down_in_the_middle_changes_nothing(up, seed):
    rng = np.random.default_rng(seed)
    across = np.roll(up, 1 + seed) * rng.choice([-1.0, 1.0])
    lying = Rotation.from_rotvec(np.pi / 2 * across)
    turns = [standing(up)] * 9
    turns[3:6] = [lying * standing(up)] * 3
    assert up_axis(track_of(turns)).tolist() == up.tolist()


@pytest.mark.parametrize("seed", range(6))
def test_whole_cartwheels_leave_it_to_the_cameras(seed):
    rng = np.random.default_rng(seed)
    up = AXES[rng.integers(6)]
    across = np.roll(up, 1)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False) + rng.uniform(0, 2 * np.pi)
    turns = [Rotation.from_rotvec(angle * across) * standing(up) for angle in angles]
    # A camera that looks down by up to 40 degrees, from any side.
    tilt = Rotation.from_rotvec(rng.uniform(0, 0.7) * np.roll(up, rng.integers(1, 3)))
    assert up_axis(track_of(turns, tilt.apply(up))).tolist() == up.tolist()


@pytest.mark.parametrize("up", AXES, ids=str)
def test_a_camera_on_its_side_turns_nobody_who_stands(up):
    assert up_axis(track_of([standing(up)] * 3, np.roll(up, 1))).tolist() == up.tolist()


@pytest.mark.parametrize("up", AXES, ids=str)
@pytest.mark.parametrize("seed", range(2))
def test_who_lies_all_the_time_lies_where_up_is_said(up, seed):
    """Alone they look as somebody who stands before a camera on its side."""
    rng = np.random.default_rng(seed)
    across = np.roll(up, 1) * rng.choice([-1.0, 1.0])
    lying = [Rotation.from_rotvec(np.pi / 2 * across) * standing(up)] * 3
    assert abs(float(up_axis(track_of(lying, up)).double().numpy() @ up)) == 0
    said = rng.uniform(0.1, 9.0) * (up + rng.uniform(-0.3, 0.3, 3))
    assert up_axis(track_of(lying, up, said)).tolist() == up.tolist()


@pytest.mark.parametrize("up", AXES, ids=str)
def test_that_pictures_and_bodies_differ_on_it_is_told_by_inspect(up):
    assert _up_lines(track_of([standing(up)] * 3, up)) == []
    (line,) = _up_lines(track_of([standing(up)] * 3, np.roll(up, 1)))
    named = [f"{'+-'[int(v.sum() < 0)]}{'xyz'[np.abs(v).argmax()]}" for v in (up, np.roll(up, 1))]
    assert f"{named[0]}, where the person" in line and f"not {named[1]}, which is up in" in line
