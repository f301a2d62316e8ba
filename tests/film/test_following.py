"""A camera that follows: the whole body in every picture, nothing before it, no black behind it."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body, up_axis
from evsplat.camera import Camera
from evsplat.errors import ConfigError, DataError
from evsplat.film.following import (
    aimed,
    follow,
    in_view,
    smoothed_pelvis,
    straight,
    to_both_sides,
    whole_turn,
)
from evsplat.film.motion import load_motion_of
from evsplat.film.surroundings import CalmRoom, Painted
from evsplat.gaussians.initialise import pixel_rays
from evsplat.models.layers import Layers
from evsplat.pictures.files import write_image
from evsplat.render import Splats
from evsplat.staging.assets import motions


@pytest.fixture(scope="module")
def recorded() -> BodyTrack:
    """Somebody who stands upright along z: rest poses turned onto their feet."""
    body = default_body()
    rest = BodyTrack(body, np.array([0]), np.zeros((1, len(body.parents), 3)), np.zeros((1, 3)))
    turn, _ = Rotation.align_vectors([[0, 0, 1.0]], [up_axis(rest).double().numpy()])
    times = np.arange(0, 1_000_001, 100_000)
    poses = np.zeros((len(times), len(body.parents), 3))
    poses[:, 0] = turn.as_rotvec()
    return BodyTrack(body, times, poses, np.zeros((len(times), 3)))


def camera_before(track: BodyTrack, width=96, height=64, away=2.0) -> Camera:
    """A camera to the side, ``away`` metres off, that sees only a part of the body."""
    target = smoothed_pelvis(track, [0])[0] + [0.4, 0, 0.2]
    K = torch.tensor([[90.0, 0, width / 2], [0, 90.0, height / 2], [0, 0, 1]])
    camera = Camera(width, height, K, torch.eye(4))
    return aimed(camera, target + [0, -away, 0.3], target, np.array([0, 0, 1.0]))


@pytest.mark.parametrize("name", motions())
def test_the_whole_person_is_in_every_picture(recorded, name):
    track = load_motion_of(name, recorded, fps=None, in_place=False)
    times = np.linspace(0, int(track.times_us[-1]), 9).round().astype(int).tolist()
    bodies = [track.vertices(time) for time in times]
    for turn in (whole_turn, to_both_sides, straight):
        cameras = follow(camera_before(recorded), track, times, torch.tensor([0, 0, 1.0]), turn)
        for camera, body in zip(cameras, bodies, strict=True):
            pixels, depth = camera.project(body)
            assert (depth > 0).all(), turn
            assert (pixels > 0).all(), turn
            assert (pixels < pixels.new_tensor([camera.width, camera.height])).all(), turn


def test_the_camera_goes_around_at_one_distance_and_looks_at_the_pelvis(recorded):
    track = load_motion_of("walk", recorded, fps=None, in_place=False)
    times = np.linspace(0, int(track.times_us[-1]), 13).round().astype(int).tolist()
    up = torch.tensor([0, 0, 1.0])
    cameras = follow(camera_before(recorded), track, times, up, whole_turn)
    targets = smoothed_pelvis(track, times)
    centers = np.stack([camera.center().numpy() for camera in cameras])
    away = centers - targets
    assert np.ptp(np.linalg.norm(away, axis=1)) < 1e-4
    angles = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert angles - angles[0] == pytest.approx(np.linspace(0, 2 * math.pi, 13), abs=1e-4)
    for camera, target in zip(cameras, targets, strict=True):
        pixel, _ = camera.project(torch.from_numpy(target).float())
        assert pixel.tolist() == pytest.approx([camera.width / 2, camera.height / 2], abs=1e-2)


def test_a_camera_from_which_somebody_walks_away_is_told(recorded):
    far = camera_before(recorded, away=6.0)
    assert in_view(far, recorded, recorded.times_us.tolist())
    assert not in_view(camera_before(recorded), recorded, recorded.times_us.tolist())


def test_the_empty_room_has_a_floor_below_the_feet_and_no_black(recorded):
    room = CalmRoom.of(recorded, recorded)
    lowest = min(float(recorded.vertices(int(t))[:, 2].min()) for t in recorded.times_us)
    assert room.floor_m == pytest.approx(lowest, abs=1e-3)
    camera = camera_before(recorded, away=4.0)
    picture = room.behind(camera, 0)
    assert picture.shape == (camera.height, camera.width, 3)
    assert picture.min() > 0.2 and picture.max() < 1
    # The soft spot is where the floor below the pelvis is.
    pelvis = torch.from_numpy(smoothed_pelvis(recorded, [0])[0]).float()
    below = torch.tensor([pelvis[0], pelvis[1], room.floor_m])
    (x, y), _ = camera.project(below)
    if 0 <= y < camera.height:
        column = picture[int(y), :, 0]
        assert int(column.argmin()) == pytest.approx(int(x), abs=1)


def splats(means: torch.Tensor) -> Splats:
    count = means.shape[1]
    return Splats(
        means,
        torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
        torch.full((1, count, 3), 0.01),
        torch.full((count,), 0.9),
        torch.zeros(1, count, 4),
    )


def test_what_stands_before_the_person_fades_but_the_floor_and_what_is_behind(recorded):
    room = CalmRoom.of(recorded, recorded)
    camera = camera_before(recorded, away=4.0)
    person = recorded.vertices(0)[None]
    middle, center = person.mean(1)[0], camera.center()
    ray = middle - center
    between, behind = center + 0.5 * ray, center + 1.5 * ray
    floor = torch.tensor([float(between[0]), float(between[1]), room.floor_m + 0.02])
    scene = splats(torch.stack((between, behind, floor))[None])
    layers = Layers(splats(person), scene, torch.eye(4).expand(1, person.shape[1], 4, 4))
    shown = room.clear(layers, camera).scene.opacities
    assert shown.tolist() == pytest.approx([0, 0.9, 0.9])


def test_a_background_is_a_colour_or_a_picture(tmp_path, recorded):
    camera = camera_before(recorded)
    white = Painted.of("#ff8000").behind(camera, 0)
    assert white.shape == (64, 96, 3)
    assert white[0, 0].tolist() == pytest.approx([1, 128 / 255, 0])
    from PIL import Image

    halves = np.zeros((10, 40, 3), np.uint8)
    halves[:, 20:] = 255
    Image.fromarray(halves).save(tmp_path / "a.png")
    picture = Painted.of(str(tmp_path / "a.png")).behind(camera, 0)
    assert picture[:, :40].max() < 0.1 and picture[:, 56:].min() > 0.9
    with pytest.raises(ConfigError, match="neither a colour"):
        Painted.of("no such colour")
    Image.fromarray(halves).convert("RGBA").save(tmp_path / "opaque.png")
    assert torch.equal(Painted.of(str(tmp_path / "opaque.png")).behind(camera, 0), picture)


@pytest.mark.parametrize("kind", ["alpha", "palette"])
def test_a_background_that_is_clear_in_places_is_refused(tmp_path, kind):
    from PIL import Image

    path = tmp_path / "a.png"
    if kind == "alpha":
        Image.new("RGBA", (8, 8), (200, 30, 30, 0)).save(path)
    else:
        few = Image.new("RGB", (8, 8), (200, 30, 30)).quantize(4)
        few.save(path, transparency=few.getpixel((0, 0)))
    with pytest.raises(ConfigError, match="transparent"):
        Painted.of(str(path))


@pytest.mark.parametrize("colour", [False, True])
def test_a_background_of_16_bits_is_as_bright_as_its_values_say(rng, tmp_path, recorded, colour):
    values = rng.integers(0, 65_536, (64, 96, 3)[: 2 + colour], dtype=np.uint16)
    write_image(tmp_path / "a.png", values)
    shown = Painted.of(str(tmp_path / "a.png")).behind(camera_before(recorded), 0)
    expected = torch.from_numpy(values / 65_535).float()
    if not colour:
        expected = expected[..., None].expand(-1, -1, 3)
    torch.testing.assert_close(shown, expected, atol=0.51 / 255, rtol=0)  # shown in 8 bits


def test_a_background_of_32_bits_is_refused(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((8, 8), 0.5, np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(DataError, match=r"a\.tif: .* expected 8 or 16"):
        Painted.of(str(tmp_path / "a.tif"))


def test_a_wall_stands_behind_all_that_the_filmed_person_does_and_looks_the_same(recorded):
    camera = camera_before(recorded, away=4.0)
    room = CalmRoom.of(recorded, recorded, camera)
    times = recorded.times_us.tolist()
    deepest = max(float(camera.project(recorded.vertices(t))[1].max()) for t in times)
    rays, center = pixel_rays(camera), camera.center()
    wall = center + 0.8 * deepest * rays[::8, ::8].flatten(0, 1)
    wall = wall[wall @ room.up > room.floor_m + 0.2]
    far = center + 2 * deepest * rays[0, :5]
    floor = wall[:3] + (room.floor_m - wall[:3] @ room.up)[:, None] * room.up
    floor = center + 0.7 * (floor - center)
    floor += (room.floor_m - floor @ room.up)[:, None] * room.up
    means = torch.cat([wall, far, floor])
    layers = Layers(splats(recorded.vertices(0)[None]), splats(means[None]), torch.eye(4)[None])
    scene = room.stand_back(layers, camera).scene
    pixels, depth = camera.project(scene.means[0])
    before, depth_before = camera.project(means)
    torch.testing.assert_close(pixels, before, atol=1e-3, rtol=0)
    assert depth[: len(wall)].min() > deepest
    torch.testing.assert_close(scene.means[0, len(wall) :], means[len(wall) :])
    torch.testing.assert_close(
        scene.scales[0, :, 0] / depth, torch.full_like(depth, 0.01) / depth_before
    )
    assert CalmRoom.of(recorded, recorded).stand_back(layers, camera) is layers


def test_a_person_alone_and_a_scene_alone_are_filmed_as_they_are(recorded):
    camera = camera_before(recorded, away=4.0)
    room = CalmRoom.of(recorded, recorded, camera)
    some, none = splats(recorded.vertices(0)[None]), splats(torch.zeros(1, 0, 3))
    for human, scene in ((some, none), (none, some)):
        layers = Layers(human, scene, torch.eye(4)[None])
        for change in (room.stand_back, room.clear, room.soften):
            changed = change(layers, camera)
            assert torch.equal(changed.human.means, human.means)
            assert changed.scene.means.shape == scene.means.shape


def test_the_rim_of_what_was_recorded_fades_as_the_camera_goes_away(recorded):
    camera = camera_before(recorded, away=4.0)
    room = CalmRoom.of(recorded, recorded, camera)
    rays = pixel_rays(camera)
    middle, rim = rays[32, 48], rays[32, 0]
    outside = rays[32, 0] + 0.2 * (rays[32, 0] - rays[32, 1]) * camera.width
    means = camera.center() + 3 * torch.stack((middle, rim, outside, -middle))
    person = recorded.vertices(0)[None]
    layers = Layers(
        splats(person), splats(means[None]), torch.eye(4).expand(1, person.shape[1], 4, 4)
    )
    assert room.soften(layers, camera).scene.opacities.tolist() == pytest.approx([0.9] * 4)
    step = 1.0 * camera.world_to_camera[0, :3]
    aside = camera_before(recorded, away=4.0)
    aside.world_to_camera[:3, 3] -= aside.world_to_camera[:3, :3] @ step
    faded = room.soften(layers, aside).scene.opacities
    assert faded[0] == pytest.approx(0.9)
    assert 0 < faded[1] < 0.05
    assert faded[2:].tolist() == [0, 0]
    halfway = camera_before(recorded, away=4.0)
    halfway.world_to_camera[:3, 3] -= halfway.world_to_camera[:3, :3] @ (0.15 * step)
    assert float(room.soften(layers, halfway).scene.opacities[2]) == pytest.approx(0.45)
    assert CalmRoom.of(recorded, recorded).soften(layers, aside) is layers
