"""Depth from a moving camera, on a wall with a board before it, both known."""

import numpy as np
import pytest
import torch

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.plane_sweep import Shot, depth_shares

SIDE, FRAMES, FOCAL, WALL = 64, 11, 70.0, 6.0
BOARD = (-0.6, 0.5, -0.8, 0.4)
"""Left, right, top and bottom of the board, metres."""


def camera_at(x: float, side: int = SIDE) -> Camera:
    """It looks along z, at ``x`` metres to the right."""
    focal = FOCAL * side / SIDE
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(side, side, K, pose)


def texture(places: torch.Tensor, phase: float) -> torch.Tensor:
    """Waves of half a metre and more, other ones on each surface."""
    waves = torch.tensor([[9.0, 3.0, 0.0], [-4.0, 8.0, 0.0], [5.0, 5.0, 0.0]])
    return 0.5 + 0.4 * torch.sin(places @ waves.T + phase)


def true_depth(camera: Camera, board: float) -> torch.Tensor:
    rays, center = pixel_rays(camera), camera.center()
    x, y, _ = (center + board * rays).unbind(-1)
    left, right, top, bottom = BOARD
    return torch.where((x > left) & (x < right) & (y > top) & (y < bottom), board, WALL)


def shot_at(x: float, board: float, noise: float, rng: np.random.Generator, side: int) -> Shot:
    camera = camera_at(x, side)
    depth = true_depth(camera, board)
    places = camera.center() + depth[..., None] * pixel_rays(camera)
    picture = texture(places, 0.0)
    picture = torch.where(depth[..., None] < WALL, texture(places, 2.0), picture)
    picture = picture + noise * torch.from_numpy(rng.standard_normal(picture.shape)).float()
    return Shot(camera, picture.clamp(0, 1), torch.ones(side, side))


@pytest.mark.parametrize("given", [WALL, 5.0])
@pytest.mark.parametrize("board, side", [(3.5, SIDE), (4.8, SIDE), (4.0, 4 * SIDE)])
def test_a_board_before_the_wall_is_as_near_as_it_is(given, board, side):
    rng = np.random.default_rng(FRAMES)
    shots = [shot_at(x, board, 0.01, rng, side) for x in np.linspace(-0.7, 0.7, FRAMES)]
    view = camera_at(0.0, side)
    found = given * depth_shares(view, torch.full((side, side), given), shots)
    true = true_depth(view, board)
    assert found.shape == true.shape
    missed = (found / true - 1).abs()
    inner = missed[side // 8 : -side // 8, side // 8 : -side // 8]
    # A window of pixels takes the rim of the wall for the board's.
    assert inner.median() < 0.03 and inner.quantile(0.85) < 0.06
    on = true < WALL
    assert missed[on].median() < 0.04


def test_what_frames_do_not_tell_stays_as_given():
    """Neither a camera that stands, nor a wall without texture, nor what the person hides."""
    rng = np.random.default_rng(3)
    given = torch.full((SIDE, SIDE), 5.0)
    still = [shot_at(0.001 * number, 3.5, 0.01, rng, SIDE) for number in range(FRAMES)]
    assert (depth_shares(camera_at(0.0), given, still) - 1).abs().max() < 1e-3
    along = np.linspace(-0.7, 0.7, FRAMES)
    plain = [
        Shot(camera_at(x), torch.full((SIDE, SIDE, 3), 0.4), torch.ones(SIDE, SIDE)) for x in along
    ]
    assert (depth_shares(camera_at(0.0), given, plain) - 1).abs().max() < 1e-3
    moving = [shot_at(x, 3.5, 0.01, rng, SIDE) for x in along]
    hidden = [Shot(shot.camera, shot.picture, torch.zeros(SIDE, SIDE)) for shot in moving]
    assert (depth_shares(camera_at(0.0), given, hidden) - 1).abs().max() < 1e-3
