"""Where the lamp hangs, and what the room looks like in its light."""

import numpy as np
import pytest

from evsplat.capture import load_capture
from evsplat.staging import stage
from evsplat.staging.camera import MAIN, TARGET
from evsplat.staging.lamp import ROOM_STRENGTH, azimuth_and_elevation, in_light_of, lamp_at
from evsplat.staging.room import Lighting, load_room

from .scenes import TWO_TRIANGLES, make_room

FLOOR = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)


@pytest.fixture(scope="module")
def room():
    return load_room()


def before(light: Lighting, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Light of a lamp that is small and hidden by nothing."""
    away = np.array(light.lamp[:3]) - places
    apart = np.linalg.norm(away, axis=-1)
    on = (away * normals).sum(-1).clip(0) / apart
    off = (-away @ light.facing).clip(0) / apart
    return light.power * on * off / apart**2


@pytest.mark.parametrize("azimuth", [-120.0, 0.0, 90.0, 180.0])
@pytest.mark.parametrize("elevation", [15.0, 60.0])
def test_lamp_hangs_where_it_is_told_and_is_as_bright_there(room, azimuth, elevation):
    light = lamp_at(room, azimuth, elevation)
    turn, up = azimuth_and_elevation(light.lamp)
    assert abs((turn - azimuth + 180) % 360 - 180) < 1e-9 and up == pytest.approx(elevation)
    way = np.subtract(light.lamp[:3], TARGET)
    assert np.cross(way, light.facing) == pytest.approx(0, abs=1e-9) and way @ light.facing < 0
    own = Lighting(lamp=tuple(room.lamp.tolist()))
    lit = [
        before(each, np.array(TARGET), ray / np.linalg.norm(ray))
        for each, ray in ((own, room.lamp[:3] - np.array(TARGET)), (light, way))
    ]
    assert lit[1] == pytest.approx(lit[0], rel=1e-6)


def test_azimuth_counts_from_the_camera_to_the_right_of_its_picture():
    assert azimuth_and_elevation(MAIN)[0] == pytest.approx(0, abs=1e-9)
    # the camera looks along +y, so that its right is +x
    assert azimuth_and_elevation((3.0, 0.0, 2.0))[0] == pytest.approx(90, abs=5)
    assert abs(azimuth_and_elevation((0.0, 3.0, 2.0))[0]) == pytest.approx(180, abs=5)
    assert azimuth_and_elevation((1.0, 0.0, TARGET[2] + 1.0))[1] == pytest.approx(45)


def test_the_ceiling_lamp_hangs_where_the_options_say(room):
    assert azimuth_and_elevation(tuple(room.lamp.tolist())) == pytest.approx((22, 56), abs=0.5)


def test_open_floor_gets_the_light_of_a_small_lamp():
    corners = FLOOR[TWO_TRIANGLES]
    light = Lighting(lamp=(1.0, -0.5, 2.0, 0.01, 0.01), facing=(-0.96, 0.0, -0.28))
    found = in_light_of(make_room(corners), light).direct
    expected = ROOM_STRENGTH * before(light, corners.reshape(-1, 3), np.array([0.0, 0.0, 1.0]))
    assert found.ravel() == pytest.approx(expected, rel=1e-3, abs=1e-12)
    assert found.min() == 0 < found.max()  # a corner lies behind the lamp


def test_what_stands_in_the_light_throws_a_shadow_away_from_the_lamp():
    # a board over the middle, and a floor in pieces of 5 cm
    steps = np.linspace(-3, 3, 121)
    low = np.stack(np.meshgrid(steps[:-1], steps[:-1], 0.0), -1).reshape(-1, 1, 3)
    floor = low + np.array([[0, 0, 0], [0.05, 0, 0], [0.05, 0.05, 0]])
    board = np.array([[-0.3, -0.3, 1], [0.3, -0.3, 1], [0.3, 0.3, 1], [-0.3, 0.3, 1]], float)
    walls = np.array([[[-3, -3, 0], [3, 3, 0], [3, 3, 2.7]]])
    corners = np.concatenate([floor, board[TWO_TRIANGLES], walls])
    way = np.array([-1.2, 0.9, -1.3]) / np.linalg.norm([-1.2, 0.9, -1.3])
    light = Lighting(lamp=(1.2, -0.9, 2.3, 0.01, 0.01), facing=tuple(way.tolist()))
    lit = in_light_of(make_room(corners), light).direct[: len(floor)].ravel()
    places = floor.reshape(-1, 3)
    lamp = np.array(light.lamp[:3])
    passed = np.abs(lamp + (lamp[2] - 1) / lamp[2] * (places - lamp))[:, :2].max(-1)
    reached = before(light, places, np.array([0.0, 0.0, 1.0])) > 0
    # a texel of the map is 4 cm wide there
    dark, free = passed < 0.3 - 0.05, (passed > 0.3 + 0.05) & reached
    assert dark.sum() > 500 and lit[dark].max() == 0
    assert lit[free].min() > 0
    middle = places[(lit == 0) & reached].mean(0)
    assert middle[:2] == pytest.approx([-1.2 / 1.3, 0.9 / 1.3], abs=0.05)


def test_room_in_its_own_lamp_is_as_it_ships(room):
    own = Lighting(lamp=tuple(room.lamp.tolist()))
    found = in_light_of(room, own).direct.ravel()
    places, up = room.corners.reshape(-1, 3), np.repeat(room.normals[:, 2], 3)
    x, y, z = places.T
    rug = (np.abs(x) < 1.3) & (y > -1.05) & (y < 0.8)
    floor = (z < 0.005) & (up > 0.9) & ~rug
    apart = found[floor] - room.direct.ravel()[floor]
    assert room.direct.ravel()[floor].mean() > 0.1
    # corners of furniture's shadows, of other points of the lamp; half floats
    assert abs(apart.mean()) < 0.005 and np.sqrt((apart**2).mean()) < 0.015


def test_side_that_faces_the_lamp_is_the_brighter(tmp_path):
    small = {"width": 48, "frames": 1, "motion": "walk", "yaw_deg": 0.0, "novel_views": "none"}
    sides = {}
    for name, azimuth in (("right", 90.0), ("left", -90.0)):
        path = stage(tmp_path / name, threads=1, progress=False, lamp_azimuth_deg=azimuth, **small)
        capture = load_capture(path)
        assert capture.provenance["settings"]["lamp_azimuth_deg"] == azimuth
        frame = capture.frames[0]
        light, person = capture.sharp(frame).mean(-1).numpy(), capture.mask(frame).numpy() > 0.9
        # each row's outermost pixels of the person
        rows = [np.flatnonzero(row) for row in person]
        ends = [(y, xs[0], xs[-1]) for y, xs in enumerate(rows) if len(xs) > 3]
        sides[name] = np.mean([light[y, right] - light[y, left] for y, left, right in ends])
    # the two sides of a person differ in colour as well
    assert sides["right"] > sides["left"] + 0.05
