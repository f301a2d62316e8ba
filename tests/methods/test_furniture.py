"""Furniture of a known room: a crate before the wall is as near as it is, and nothing else is."""

import numpy as np
import pytest
import torch

from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.furniture import behind_things, furnished

from .rooms import HEIGHT_M, Crate, camera_over, met, painted, pillar, room_of


@pytest.mark.parametrize("roll", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_a_crate_is_nearer_than_the_wall_behind_it(seed, roll):
    rng = np.random.default_rng(seed)
    room = room_of(5.0, 3.0, 3.0, feet=(0.3, 2.5))
    left, front = rng.uniform(-1.2, -0.6), rng.uniform(3.6, 4.2)
    crate = Crate((left, front, -HEIGHT_M), (left + 0.8, front + 0.7, rng.uniform(-0.7, -0.4)))
    camera = camera_over(rng.uniform(-0.2, 0.1), 0.15, roll)
    shares = furnished(camera, painted(room, camera, rng, crate), room, pillar(0.3, 2.5))
    which, depth = met(room, camera, crate)
    there = which == len(room.normals)
    bare = room.depth(camera)
    # Of its upper end half the way to the wall is taken, which a seat has and a crate has not.
    wrong = (shares * bare / depth - 1).abs()
    assert (bare / depth - 1)[there].median() > 0.1
    assert wrong[there].median() < 0.06
    assert (shares[~there] == 1).float().mean() > 0.995


@pytest.mark.parametrize("seed", range(4))
def test_a_front_leans_half_as_much_as_what_leads_back_to_its_upper_end(seed):
    rng = np.random.default_rng(seed)
    room, camera = (
        room_of(5.0, 3.0, 3.0, feet=(0.3, 2.5)),
        camera_over(rng.uniform(-0.2, 0.1), 0.15),
    )
    left, front, top = rng.uniform(-1.2, -0.6), rng.uniform(3.6, 4.2), rng.uniform(-0.7, -0.4)
    crate = Crate((left, front, -HEIGHT_M), (left + 0.8, front + 0.7, top))
    shares = furnished(camera, painted(room, camera, rng, crate), room, pillar(0.3, 2.5))
    which, depth = met(room, camera, crate)
    _, away, height = (depth[..., None] * pixel_rays(camera)).unbind(-1)
    upper = (which == len(room.normals)) & (away < front + 0.01) & (height > top - 0.3)
    wrong = (shares * room.depth(camera) / depth - 1).abs()
    assert upper.sum() > 50
    # Of the way to the wall, 5 m away: half of that would be if it leant all the way back.
    assert wrong[upper].median() < 0.25 * (1 - front / 5)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_in_an_empty_room(seed):
    rng = np.random.default_rng(seed)
    room, camera = room_of(5.0, 3.0, 3.0), camera_over(rng.uniform(-0.4, 0.4), 0.15)
    shares = furnished(camera, painted(room, camera, rng), room, pillar(0, 2))
    assert (shares == 1).float().mean() > 0.95


def test_nothing_stands_before_the_person():
    rng = np.random.default_rng(0)
    room, camera = room_of(5.0, 3.0, 3.0), camera_over(0.0, 0.15)
    crate = Crate((-0.5, 3.0, -HEIGHT_M), (0.5, 3.4, -0.5))
    body = pillar(0.0, 3.8)
    shares = furnished(camera, painted(room, camera, rng, crate), room, body)
    pixels, depth = camera.project(body)
    x, y = pixels.long().unbind(-1)
    assert (shares < 1).any()
    assert (shares[y, x] * room.depth(camera)[y, x] > depth).all()


def test_floor_and_walls_go_on_behind_things():
    room, camera = room_of(5.0, 3.0, 3.0), camera_over(0.1, 0.15)
    depth, shares = room.depth(camera), torch.ones(camera.height, camera.width)
    shares[40:90, 30:71] = 0.8
    shade = torch.linspace(0.2, 0.6, camera.width).expand(camera.height, -1)
    picture = shade[..., None].repeat(1, 1, 3)
    picture[39:91, 29:72] = torch.tensor([1.0, 0.0, 0.0])
    places, scales, colours = behind_things(camera, picture, depth, shares)
    pixels, away = camera.project(places)
    x, y = pixels.long().unbind(-1)
    assert torch.allclose(away, depth[y, x], rtol=1e-4)
    drawn = torch.zeros_like(shares)
    drawn[y, x] = 1
    assert (torch.nn.functional.max_pool2d(drawn[None], 3, 1, 1)[0] > 0)[shares < 1].all()
    assert not drawn[:30].any() and not drawn[:, 80:].any()
    assert (scales > away[:, None] / camera.K[0, 0]).all()
    assert torch.allclose(colours, shade[y, x, None].expand(-1, 3), atol=0.08)
