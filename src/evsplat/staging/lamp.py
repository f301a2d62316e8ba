"""The lamp hung elsewhere, and the room in its light."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from evsplat.staging.camera import MAIN, TARGET, look_at
from evsplat.staging.room import Lighting, RoomMesh

ROOM_STRENGTH = 1.4
"""Light of the lamp on the room against that on the person, as the room that ships was baked."""
_PER_SIDE = 5
"""Points that stand for the lamp along each of its sides."""
_SHELL_M = 0.03
"""What lies as near to the room's limits hides nothing from the lamp: walls, pictures, a rug."""
_SPACING_M = 0.03
_MAP_TEXELS = 256
"""Along a side of the map of what furniture hides, 4.7 cm at 3 m: wider than the spacing of the
points that it is made of, so that it has no holes."""
_BIAS_M = 0.04
_CAMERA = float(np.arctan2(MAIN[1] - TARGET[1], MAIN[0] - TARGET[0]))
"""Where the recording camera is about the person, radians from x."""


def azimuth_and_elevation(place: tuple[float, ...]) -> tuple[float, float]:
    """Where a place is about the person: degrees from the recording camera, and above the level.

    Azimuths go counter-clockwise as seen from above, in -180..180: 90 is at the right of the
    picture, 180 behind the person. Both are of the middle of a person who stands in the middle.
    """
    x, y, z = np.subtract(place[:3], TARGET)
    turn = np.degrees(np.arctan2(y, x) - _CAMERA)
    return float((turn + 180) % 360 - 180), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def lamp_at(room: RoomMesh, azimuth_deg: float | None, elevation_deg: float | None) -> Lighting:
    """The room's lamp hung elsewhere, as far from the person's middle, which it shines at.

    There it is as bright as where the room has it. Angles as in `azimuth_and_elevation`, each the
    room's own where it is None.
    """
    x, y, z, *half = (float(value) for value in room.lamp)
    own = np.subtract((x, y, z), TARGET)
    distance = float(np.linalg.norm(own))
    azimuth, elevation = azimuth_and_elevation((x, y, z))
    azimuth = azimuth if azimuth_deg is None else azimuth_deg
    elevation = elevation if elevation_deg is None else elevation_deg
    turn = np.radians(azimuth) + _CAMERA
    level, up = np.cos(np.radians(elevation)), np.sin(np.radians(elevation))
    way = np.array([level * np.cos(turn), level * np.sin(turn), up])
    px, py, pz = (TARGET + distance * way).tolist()
    fx, fy, fz = (-way).tolist()
    light = Lighting(lamp=(px, py, pz, half[0], half[1]), facing=(fx, fy, fz))
    # the lamp that shines down is seen at a slant from there
    strength = light.lamp_strength * float(own[2]) / distance
    return replace(light, lamp_strength=strength, shadow_way=light.facing)


def in_light_of(room: RoomMesh, light: Lighting) -> RoomMesh:
    """The room with its direct light baked anew, furniture's shadows included.

    Light from elsewhere stays as it was baked.
    """
    points, each = _points(light), ROOM_STRENGTH * light.power / _PER_SIDE**2
    hides = _samples(room.corners[_stands(room)].astype(np.float64))
    corners = np.concatenate((room.corners, np.repeat(room.normals[:, None], 3, axis=1)), -1)
    different, index = np.unique(corners.reshape(-1, 6).round(5), axis=0, return_inverse=True)
    places, normals = different[:, :3].astype(np.float64), different[:, 3:].astype(np.float64)
    direct = np.zeros(len(places))
    frame = look_at(np.zeros(3), light.facing, up=(0, 1, 0))[:3, :3]
    # what lies nearer to a point of the lamp than these are apart would show the single points
    nearest = (2 * min(light.lamp[3:]) / _PER_SIDE) ** 2
    for point in points:
        hidden = _Hidden(point, frame, hides)
        away = point - places
        apart = np.sqrt((away**2).sum(-1)).clip(1e-6)
        on = (away * normals).sum(-1).clip(0) / apart
        off = (away @ -np.asarray(light.facing)).clip(0) / apart
        lit = each * on * off / (apart**2).clip(nearest)
        direct += np.where(hidden.at(places), 0, lit)
    return replace(room, direct=direct[index.reshape(-1, 3)].astype(np.float32))


def _points(light: Lighting) -> Float[np.ndarray, "P 3"]:
    """Middles of equal parts of the lamp."""
    centre = np.array(light.lamp[:3])
    sides = look_at(centre, centre + light.facing, up=(0, 1, 0))[:2, :3]
    steps = (np.arange(_PER_SIDE) + 0.5) / _PER_SIDE * 2 - 1
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    return centre + (grid * light.lamp[3:]) @ sides


def _stands(room: RoomMesh) -> Bool[np.ndarray, "F"]:
    """True for triangles that stand off floor, ceiling and walls."""
    low, high = room.corners.min((0, 1)) + _SHELL_M, room.corners.max((0, 1)) - _SHELL_M
    outside = (room.corners < low) | (room.corners > high)
    return ~outside.all(1).any(1)


def _samples(corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Points of triangles, at most about `_SPACING_M` apart, none of them twice."""
    found = [np.zeros((0, 3))]
    size = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(-1)
    parts = np.ceil(size / _SPACING_M).astype(int)
    for count in np.unique(parts):
        steps = np.arange(count + 1) / max(count, 1)
        u, v = (part.ravel() for part in np.meshgrid(steps, steps))
        shares = np.stack([1 - u - v, u, v], -1)[u + v <= 1 + 1e-9]
        found.append((shares @ corners[parts == count]).reshape(-1, 3))
    points = np.concatenate(found)
    cells = np.floor(points / (0.5 * _SPACING_M)).astype(np.int64)
    cells -= cells.min(0, initial=0)
    number = np.ravel_multi_index(tuple(cells.T), cells.max(0, initial=0) + 1)
    return points[np.unique(number, return_index=True)[1]]


class _Hidden:
    """What points before the lamp hide from one of its points."""

    def __init__(
        self,
        eye: Float[np.ndarray, "3"],
        frame: Float[np.ndarray, "3 3"],
        points: Float[np.ndarray, "N 3"],
    ) -> None:
        self.eye, self.frame = eye, frame
        self.nearest = np.full(_MAP_TEXELS**2, np.inf)
        before = (points - eye) @ frame[2] > 0
        texel, apart = self._seen(points[before])
        np.minimum.at(self.nearest, texel, apart)

    def at(self, places: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        """True where something is nearer."""
        texel, apart = self._seen(places)
        hidden: np.ndarray = self.nearest[texel] < apart - _BIAS_M
        return hidden

    def _seen(
        self, places: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Texels of the stereographic map of the half space before the lamp, and distances."""
        x, y, z = self.frame @ (places - self.eye).T
        apart = np.sqrt(x * x + y * y + z * z).clip(1e-6)
        scale = 0.5 * _MAP_TEXELS / (apart + z.clip(0))
        column, row = (
            (along * scale + 0.5 * _MAP_TEXELS).astype(int).clip(0, _MAP_TEXELS - 1)
            for along in (x, y)
        )
        return row * _MAP_TEXELS + column, np.where(z > 0, apart, 0.0)
