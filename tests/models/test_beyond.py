"""Beside the recording camera floor and wall go on, and a wall hides nobody from behind."""

import math
from dataclasses import replace

import pytest
import torch

from evsplat.camera import Camera
from evsplat.capture import load_body_track, load_capture
from evsplat.models.beyond import Beyond, on_floor, ray_directions
from evsplat.models.layers import Layers
from evsplat.render import Splats, render
from evsplat.training import load_run, train

from ..small_model import small

UP = torch.tensor([0.0, -1.0, 0.0])
FLOOR_RGB, WALL_RGB = torch.tensor([0.6, 0.4, 0.2]), torch.tensor([0.2, 0.3, 0.7])


def camera(center=(0.0, 0.0, 0.0), yaw=0.0, pitch=0.0) -> Camera:
    """40 x 30 pixels; turned by yaw to the right and pitch downwards, radians."""
    to_right = torch.tensor(
        [[math.cos(yaw), 0, -math.sin(yaw)], [0, 1, 0], [math.sin(yaw), 0, math.cos(yaw)]]
    )
    down = torch.tensor(
        [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]]
    )
    pose = torch.eye(4)
    pose[:3, :3] = down @ to_right
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(center)
    K = torch.tensor([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]])
    return Camera(40, 30, K, pose)


def room() -> Beyond:
    """Floor 1.5 m below the camera, the person 3 m before it, the wall 1 m behind them."""
    middle = torch.tensor([0.0, 0.5, 3.0])
    return Beyond(camera(), UP, -1.5, middle, 1.0, FLOOR_RGB, WALL_RGB)


def test_rays_meet_the_floor_where_geometry_says():
    seen_by = camera(center=(0.3, -0.2, 0.1), yaw=0.4, pitch=0.2)
    places, meets = on_floor(seen_by, ray_directions(seen_by), UP, -1.5)
    assert meets.any() and not meets.all()
    assert torch.allclose(places[meets] @ UP, torch.tensor(-1.5), atol=1e-5)
    pixels, depth = seen_by.project(places[meets])
    rows, columns = meets.nonzero().unbind(-1)
    assert bool((depth > 0).all())
    # A ray all but level comes down far away, where float32 tells pixels to a hundredth.
    assert torch.allclose(pixels, torch.stack([columns, rows], -1) + 0.5, atol=0.02)


def test_below_the_floor_no_ray_meets_it():
    below = camera(center=(0.0, 2.0, 0.0), pitch=0.3)
    assert not on_floor(below, ray_directions(below), UP, -1.5)[1].any()


def test_the_floor_ends_at_the_wall():
    seen_by = camera(pitch=0.4)
    picture = room().behind(seen_by)
    places, meets = on_floor(seen_by, ray_directions(seen_by), UP, -1.5)
    away = (places - room().middle)[..., [0, 2]].norm(dim=-1)
    near, far = meets & (away < 1.0), ~meets | (away > 2.0)
    assert near.any() and far.any() and (~near & ~far).any()
    assert torch.allclose(picture[near], FLOOR_RGB.expand_as(picture[near]))
    assert torch.allclose(picture[far], WALL_RGB.expand_as(picture[far]))


def test_holes_are_filled_and_what_is_solid_stays():
    seen_by, alpha = camera(), torch.ones(1, 30, 40)
    alpha[:, :, 20:] = 0.0
    rgb = torch.full((1, 30, 40, 3), 0.4) * alpha[..., None]
    filled = room().fill(rgb, alpha, seen_by)
    assert torch.allclose(filled[0, :, 20:], room().behind(seen_by)[:, 20:])
    assert torch.equal(filled[:, :, :20], rgb[:, :, :20])


@pytest.mark.parametrize(
    ("center", "yaw", "hidden"),
    [
        ((0.0, 0.0, 0.0), 0.0, False),
        ((2.0, 0.0, 1.5), -0.9, False),
        ((0.0, 0.0, 6.0), math.pi, True),
    ],
)
def test_a_wall_hides_the_person_from_the_front_alone(center, yaw, hidden):
    places = torch.tensor([[0.0, 0.0, 4.0], [0.5, 1.49, 3.9]])  # wall and floor
    scene = Splats(
        places[None],
        torch.eye(4)[:1].repeat(2, 1),
        torch.full((2, 3), 0.3),
        torch.tensor([0.9, 0.9]),
        torch.ones(1, 2, 4),
    )
    layers = Layers(scene, scene, torch.eye(4).expand(1, 2, 4, 4))
    shown = room().uncovered(layers, camera(center, yaw))
    assert shown.human is scene
    assert shown.scene.opacities.tolist() == pytest.approx([0.0 if hidden else 0.9, 0.9])
    alpha = render(shown.scene, camera(center, yaw)).alpha
    assert (float(alpha[0, :14].max()) < 0.1) == hidden


def test_a_run_goes_on_beside_the_camera_and_stays_as_it_is_before_it(tiny_capture, tmp_path):
    out = tmp_path / "run"
    train(tiny_capture(), out=out, overrides=small("evsplat"), iterations=4)
    trained = load_run(out)
    capture = trained.capture
    recording = capture.camera(capture.train_frames[0])
    turned = recording.world_to_camera.clone()
    turned[:3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ turned[:3]
    aside = replace(recording, world_to_camera=turned)
    time = [capture.train_frames[0].mid_us]
    plain, beside = trained.reconstruction, trained.beside()
    holes = plain.render(aside, time).alpha < 0.01
    assert holes.any()
    assert float(plain.render(aside, time).rgb[holes].max()) < 0.02
    assert float(beside.render(aside, time).rgb[holes].max(-1).values.min()) > 0.05
    change = beside.render(recording, time).rgb - plain.render(recording, time).rgb
    assert float(change.abs().max()) < 0.05
    # The person alone has nothing behind it.
    alone = beside.render(aside, time, parts="human").rgb
    assert torch.equal(alone, plain.render(aside, time, parts="human").rgb)


def test_colours_are_those_of_the_rim(tiny_capture):
    capture = load_capture(tiny_capture())
    track, recording = load_body_track(capture), capture.camera(capture.frames[0])
    size = recording.height, recording.width
    picture = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0))
    found = Beyond.of(recording, track, picture, torch.full(size, 1e-3))
    width = max(1, round(min(size) / 16))
    inner = torch.zeros(size, dtype=torch.bool)
    inner[width:-width, width:-width] = True
    # All places are at the camera's height: a wall.
    assert torch.allclose(found.wall_rgb, picture[~inner].mean(0))
    assert torch.allclose(found.floor_rgb, picture.mean((0, 1)))
