import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.staging.renderer import StageRenderer
from evsplat.staging.room import Lighting

from . import reference
from .scenes import (
    AMBIENT_ONLY,
    LAMP,
    LIGHTS,
    SQUARE_UV,
    TWO_TRIANGLES,
    WHITE,
    bones,
    front_camera,
    make_person,
    make_room,
    square,
)

FAR_WALL = make_room(square(-50, 50, -50, 50, 20.0)[TWO_TRIANGLES])


def draw(character, room=FAR_WALL, light=AMBIENT_ONLY, camera=None, shift=(0, 0, 0), **options):
    renderer = StageRenderer(room, character, light, threads=1)
    pictures, masks = renderer.draw(camera or front_camera(), bones(shift), **options)
    return pictures[0], masks[0]


def colour_atlas(*colours: tuple[int, int, int]) -> np.ndarray:
    """Upright stripes of equal width, 16 pixels each."""
    stripes = np.repeat(np.uint8(colours), 16, axis=0)
    atlas = np.full((16, len(stripes), 4), 255, np.uint8)
    atlas[..., :3] = stripes
    return atlas


def test_square_on_pixel_edges_covers_exactly_those_pixels():
    # focal 32 at depth 2: 16 pixels per metre, the picture's middle at pixel 16
    person = make_person(square(-0.5, 0.25, -0.125, 0.75, 2.0), TWO_TRIANGLES)
    _, mask = draw(person)
    expected = np.zeros((32, 32))
    expected[4:18, 8:20] = 1
    assert np.array_equal(mask, expected)


def test_coverage_of_turned_triangles_is_their_area():
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(20):
        corners = rng.uniform(-0.8, 0.8, (3, 3)) + (0, 3, 0)
        person = make_person(corners, np.array([[0, 1, 2]]))
        _, mask = draw(person, camera=front_camera(64, 64.0))
        pixels = 64 * corners[:, [0, 2]] / corners[:, 1:2]
        edges = pixels[1] - pixels[0], pixels[2] - pixels[0]
        area = abs(edges[0][0] * edges[1][1] - edges[0][1] * edges[1][0]) / 2
        outline = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1).sum()
        # a sample stands for a quarter of a pixel; an edge misjudges those along it at random
        assert abs(mask.sum() - area) < 0.25 * np.sqrt(outline) + 1
        errors.append(mask.sum() - area)
    assert abs(np.mean(errors)) < 0.5


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearer_square_hides_the_farther_in_any_order(order):
    near, far = square(-0.5, 0.5, -0.5, 0.5, 2.0), square(-2, 2, -2, 2, 3.0)
    faces = np.concatenate([[TWO_TRIANGLES, TWO_TRIANGLES + 4][k] for k in order])
    uv = np.concatenate([np.full((4, 2), 0.25), np.full((4, 2), 0.75)])
    atlas = colour_atlas((255, 0, 0), (0, 0, 255))
    picture, mask = draw(
        make_person(np.concatenate([near, far]), faces, uv=uv * (1, 0) + (0, 0.5), atlas=atlas)
    )
    assert picture[16, 16] == pytest.approx([1, 0, 0])
    assert picture[16, 4] == pytest.approx([0, 0, 1])
    assert mask.min() == 1


def test_wall_before_the_person_hides_them():
    person = make_person(square(-1, 1, -1, 1, 3.0), TWO_TRIANGLES)
    room = make_room(
        np.concatenate([square(-9, 9, -9, 9, 9.0), square(-9, 0, -9, 9, 2.0)])[
            np.concatenate([TWO_TRIANGLES, TWO_TRIANGLES + 4])
        ]
    )
    _, mask = draw(person, room)
    assert mask[:, :16].max() == 0
    assert mask[16, 16:26].min() == 1


def test_texture_on_a_slanted_square_is_perspective_correct():
    # the left edge is 1.5 m away, the right edge 6 m; the texture is a ramp along u
    corners = np.array([[-1, 1.5, 1], [2, 6, 1], [2, 6, -1], [-1, 1.5, -1]], float)
    ramp = np.full((256, 256, 4), 255, np.uint8)
    ramp[..., :3] = np.arange(256)[:, None]
    person = make_person(corners, TWO_TRIANGLES, uv=SQUARE_UV, atlas=ramp)
    picture, mask = draw(person, camera=front_camera(64, 64.0))
    columns = np.flatnonzero(mask[32] == 1)
    coded = picture[32, columns, 0] ** (1 / 2.2)
    slope = (columns + 0.5 - 32) / 64  # x / y of the ray
    # x = -1 + 3 u, y = 1.5 + 4.5 u
    u = (1.5 * slope + 1) / (3 - 4.5 * slope)
    expected = (255 * u - 0.5).round(2) / 255
    assert np.abs(coded - expected).max() < 0.02
    pixels = 64 * np.array([-1 / 1.5, 2 / 6]) + 32
    without_perspective = (columns + 0.5 - pixels[0]) / (pixels[1] - pixels[0])
    assert np.abs(without_perspective - expected).max() > 0.2


def test_floor_that_runs_past_behind_the_camera_is_seen_up_to_the_near_plane():
    floor = np.array([[-9, -9, -1], [9, -9, -1], [9, 9, -1], [-9, 9, -1]], float)
    person = make_person(floor, TWO_TRIANGLES)
    _, mask = draw(person, make_room(square(-50, 50, -50, 50, 30.0)[TWO_TRIANGLES]))
    # depth of the floor at row v: focal / (v - 16); it ends 9 m away, 3.6 pixels below the horizon
    assert mask[:19].max() == 0
    assert mask[20:].min() == 1


def test_transparent_parts_of_the_atlas_cut_holes_only_where_told():
    atlas = colour_atlas((255, 255, 255), (255, 255, 255))
    atlas[:, :16, 3] = 0
    corners = square(-1, 1, -1, 1, 2.0)
    for cutout, left in ((True, 0), (False, 1)):
        person = make_person(corners, TWO_TRIANGLES, uv=SQUARE_UV, atlas=atlas, cutout=cutout)
        _, mask = draw(person)
        assert mask[16, 8] == left
        assert mask[16, 24] == 1


def test_coarse_textures_are_averaged_in_linear_light():
    checker = np.zeros((1, 64, 64, 3), np.uint8)
    checker[:, ::2, ::2] = checker[:, 1::2, 1::2] = 255
    wall = square(-2, 2, -2, 2, 2.0)[TWO_TRIANGLES]
    room = make_room(wall, uv=4 * SQUARE_UV[TWO_TRIANGLES], textures=checker)
    hidden = make_person(square(-1, 1, -1, 1, -5.0), TWO_TRIANGLES)
    picture, mask = draw(hidden, room)
    assert mask.max() == 0
    assert np.allclose(picture, 0.5, atol=1e-3)


def lamp_scene() -> tuple:
    """A square of 0.6 m, 1 m above a lit floor, and a camera that looks down on both."""
    floor = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)[TWO_TRIANGLES]
    room = make_room(floor, direct=0.7, ambient=0.2)
    side = 0.3
    corners = np.array([[-side, -side, 1], [side, -side, 1], [side, side, 1], [-side, side, 1]])
    camera = front_camera(64, 50.0)
    pose = torch.eye(4)
    tilt = Rotation.from_euler("x", 55, degrees=True).as_matrix()
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ tilt
    pose[:3, :3] = torch.from_numpy(turn).float()
    pose[:3, 3] = torch.from_numpy(-turn @ np.array([0, -2.0, 2.4])).float()
    camera = type(camera)(64, 64, camera.K, pose)
    return room, make_person(corners, TWO_TRIANGLES), camera


def floor_places(camera) -> np.ndarray:
    eye, rays = reference.camera_rays(camera, 1)
    return (eye + rays * (-eye[2] / rays[:, 2:])).reshape(camera.height, camera.width, 3)


@pytest.mark.parametrize(
    ("light", "least"), list(zip(LIGHTS.values(), (30, 20), strict=True)), ids=LIGHTS
)
def test_shadow_falls_where_the_square_hides_the_lamp(light, least):
    room, person, camera = lamp_scene()
    picture, mask = draw(person, room, light, camera)
    places = floor_places(camera)
    on_floor = (mask == 0) & (np.abs(places[..., :2]).max(-1) < 2.5)
    # where the ray from the lamp to the floor passes the square's height
    lamp = np.array(light.lamp[:3])
    share = (lamp[2] - 1) / lamp[2]
    passed = np.abs(lamp + share * (places - lamp))[..., :2].max(-1)
    # soft edge on the square's plane: its angle times the distance from the lamp, aslant the more
    soft = (lamp[2] - 1) * 0.016 * 2.9 / light.facing[2] ** 2
    light = picture[..., 0]
    lit, dark = on_floor & (passed > 0.3 + soft + 0.05), on_floor & (passed < 0.3 - soft - 0.05)
    far = lit & (np.linalg.norm(places, axis=-1) > 1.5)
    assert lit.sum() > 200 and dark.sum() > least
    assert np.allclose(light[far], 0.9, atol=1e-6)
    assert light[dark].max() <= 0.2 + 1e-6
    edge = light[on_floor & ~lit & ~dark]
    assert edge.min() >= 0 and len(np.unique(edge.round(3))) > 20


def test_without_shadows_the_room_stays_as_it_is_when_empty():
    room, person, camera = lamp_scene()
    with_person, mask = draw(person, room, Lighting(lamp=LAMP), camera, shadows=False)
    empty, _ = draw(person, room, Lighting(lamp=LAMP), camera, shift=(0, 0, 50), shadows=False)
    assert mask.max() == 1
    assert np.array_equal(with_person[mask == 0], empty[mask == 0])
    shaded, _ = draw(person, room, Lighting(lamp=LAMP), camera)
    assert (shaded[mask == 0] < empty[mask == 0] - 0.1).any()
    assert np.array_equal(shaded[mask == 1], with_person[mask == 1])


def random_scene(seed: int):
    rng = np.random.default_rng(seed)
    floor = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)[TWO_TRIANGLES]
    loose = rng.uniform((-1.5, 0.2, 0.1), (1.5, 2.5, 2), (6, 1, 3)) + rng.normal(0, 0.4, (6, 3, 3))
    corners = np.concatenate([floor, loose])
    textures = rng.integers(0, 256, (1, 32, 32, 3)).astype(np.uint8)
    room = make_room(
        corners,
        uv=rng.uniform(-2, 3, (8, 3, 2)),
        textures=textures,
        tint=rng.uniform(0.3, 1, (8, 3)),
        direct=rng.uniform(0, 1, (8, 3)),
        ambient=rng.uniform(0, 0.5, (8, 3, 3)),
    )
    vertices = rng.uniform((-0.8, -0.6, 0.2), (0.8, 0.8, 1.8), (9, 3))
    atlas = rng.integers(0, 256, (32, 64, 4)).astype(np.uint8)
    person = make_person(
        vertices,
        np.arange(9).reshape(3, 3),
        uv=rng.uniform(0, 1, (9, 2)),
        atlas=atlas,
        normals=rng.normal(size=(9, 3)),
        cutout=bool(seed % 2),
    )
    camera = front_camera(24, 22.0)
    pose = camera.world_to_camera.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0.2, -3.0, 1.3])
    return room, person, type(camera)(24, 24, camera.K, pose)


@pytest.mark.parametrize("light", list(LIGHTS.values()), ids=LIGHTS)
@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_rays_in_float64(seed, light):
    room, person, camera = random_scene(seed)
    renderer = StageRenderer(room, person, light, threads=1)
    pose = bones((0.05, -0.1, 0.02))
    picture, mask = (array[0] for array in renderer.draw(camera, pose))
    shift = pose[0, 0, :3, 3].numpy()
    joints = person.body.rest_joints.numpy()[renderer.contact_joints] + shift
    expected = reference.draw(
        room, person, light, camera, person.vertices + shift, person.normals, joints
    )
    # samples within rounding of an edge may fall to either side
    apart = np.abs(np.concatenate([picture, mask[..., None]], -1) - expected).max(-1)
    assert (apart > 2e-4).mean() < 0.01
    assert np.median(apart) < 1e-5


def test_pictures_do_not_depend_on_threads_or_batches():
    room, person, camera = random_scene(1)
    poses = torch.cat([bones((0.02 * t, 0, 0.01 * t)) for t in range(5)])
    path = camera.world_to_camera.repeat(5, 1, 1).numpy()
    path[:, 0, 3] += np.linspace(0, 0.2, 5)
    for moving in (None, path):
        one = StageRenderer(room, person, threads=1).draw(camera, poses, world_to_camera=moving)
        many = StageRenderer(room, person, threads=3).draw(camera, poses, world_to_camera=moving)
        assert np.array_equal(one[0], many[0]) and np.array_equal(one[1], many[1])
        again = StageRenderer(room, person, threads=2)
        for t in range(5):
            here = None if moving is None else moving[t : t + 1]
            single = again.draw(camera, poses[t : t + 1], world_to_camera=here)
            assert np.array_equal(single[0][0], one[0][t])


def test_camera_that_moves_sees_what_one_at_its_place_sees():
    room, person, camera = random_scene(2)
    renderer = StageRenderer(room, person, threads=1)
    pose = camera.world_to_camera.clone()
    pose[:3, 3] += torch.tensor([0.1, -0.05, 0.2])
    moved, mask = renderer.draw(camera, bones(), world_to_camera=pose[None].numpy())
    there, expected = renderer.draw(type(camera)(24, 24, camera.K, pose), bones())
    assert np.array_equal(mask, expected)
    # two samples of the room per pixel and axis in place of four
    assert np.abs(moved.mean((1, 2)) - there.mean((1, 2))).max() < 0.02


def test_white_texture_is_the_light_itself():
    hidden = make_person(square(-1, 1, -1, 1, -5.0), TWO_TRIANGLES)
    wall = square(-2, 2, -2, 2, 2.0)[TWO_TRIANGLES]
    picture, _ = draw(hidden, make_room(wall, textures=WHITE, direct=0.25, ambient=0.5, tint=0.5))
    assert np.allclose(picture, 0.375, atol=1e-6)
