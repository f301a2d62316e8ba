"""A room from one picture of it: boxes with brick walls and a plank floor, whose truth is known."""

import math

import numpy as np
import pytest
import torch

from evsplat.methods.line_directions import Lines, level_axes, wall_turn
from evsplat.methods.room import find_room

from .rooms import SIDE, UP, camera_over, met, painted, pillar, room_of


@pytest.mark.parametrize("seed", range(3))
def test_depth_is_that_of_the_first_plane_that_a_ray_meets(seed):
    rng = np.random.default_rng(seed)
    camera = camera_over(rng.uniform(-0.6, 0.6), 0.1, rng.uniform(-0.3, 0.3))
    room = room_of(4.0, *rng.uniform(1, 5, 2).tolist())
    assert torch.allclose(room.depth(camera), met(room, camera)[1], rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_turn_of_walls_is_found_and_noise_has_none(seed):
    rng = np.random.default_rng(seed)
    camera = camera_over(rng.uniform(-0.6, 0.6), rng.uniform(0, 0.2), rng.uniform(-0.1, 0.1))
    picture = painted(room_of(5.0, 3.0, 3.0), camera, rng)
    found, agreement = wall_turn(Lines.of(picture.double().numpy(), camera), UP)
    along, ahead = level_axes(camera, UP, found)
    assert max(ahead.abs().max(), along.abs().max()) > math.cos(math.radians(2.5))
    noise = torch.from_numpy(rng.random((SIDE, SIDE, 3))).float()
    _, by_chance = wall_turn(Lines.of(noise.double().numpy(), camera), UP)
    assert by_chance < 0.35 < 0.45 < agreement
    assert find_room(camera, noise, pillar(0, 2.5), UP) is None


def test_walls_stand_where_floor_and_skirting_boards_meet():
    missed = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        true = room_of(rng.uniform(3.6, 6), *rng.uniform(1.5, 4, 2).tolist())
        turn, away = rng.uniform(-0.5, 0.5), rng.uniform(2, 2.6)
        camera = camera_over(turn, rng.uniform(0.05, 0.2), rng.uniform(-0.1, 0.1))
        body = pillar(away * math.sin(turn), away * math.cos(turn))
        found = find_room(camera, painted(true, camera, rng), body, UP)
        assert found is not None
        assert (body @ found.normals.T < found.offsets + 1e-5).all()
        missed.append((found.depth(camera) / true.depth(camera) - 1).abs().median())
    # A board of the floor's colour looks like floor: the wall then stands on its upper end.
    assert max(missed) < 0.09 and sorted(missed)[-3] < 0.03


@pytest.mark.parametrize("tilt", [1.3, -1.3])
def test_a_camera_that_looks_up_or_down_sees_no_room(tilt):
    camera = camera_over(0.0, tilt)
    picture = painted(room_of(4.0, 2.0, 2.0), camera, np.random.default_rng(0))
    assert find_room(camera, picture, pillar(0, 1.5), UP) is None


def test_a_camera_on_the_floor_sees_no_room():
    camera = camera_over(0.0)
    picture = painted(room_of(4.0, 2.0, 2.0), camera, np.random.default_rng(0))
    assert find_room(camera, picture, pillar(0, 2.5) + UP * 1.3, UP) is None
