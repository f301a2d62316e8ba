"""Small rooms and persons of a few triangles, for closed forms and the slow reference."""

import numpy as np
import torch

from evsplat.body import default_body
from evsplat.capture import Camera
from evsplat.staging.character import Character
from evsplat.staging.room import Lighting, RoomMesh

WHITE = np.full((1, 16, 16, 3), 255, np.uint8)
LAMP = (0.0, 0.0, 2.6, 0.5, 0.5)
_PLACE, _AIM = np.array([1.1, -0.8, 2.3]), np.array([0.0, 0.0, 1.0])
_WAY = (_AIM - _PLACE) / np.linalg.norm(_AIM - _PLACE)
LIGHTS = {
    "from above": Lighting(lamp=LAMP),
    "aslant": Lighting(
        lamp=(*_PLACE.tolist(), 0.5, 0.5),
        facing=tuple(_WAY.tolist()),
        shadow_way=tuple(_WAY.tolist()),
    ),
}
"""A lamp in the ceiling and one that shines from the side."""
AMBIENT_ONLY = Lighting(
    lamp=LAMP,
    lamp_strength=0.0,
    ambient_below=(1, 1, 1),
    ambient_above=(1, 1, 1),
    rim=0.0,
    specular=0.0,
)
"""Colours on the person come out as the texture has them."""


def make_room(
    corners: np.ndarray,
    *,
    uv: np.ndarray | None = None,
    textures: np.ndarray = WHITE,
    tint: np.ndarray | float = 1.0,
    direct: np.ndarray | float = 0.0,
    ambient: np.ndarray | float = 1.0,
) -> RoomMesh:
    """Triangles (F, 3, 3) in even light."""
    corners = np.asarray(corners, np.float32)
    count = len(corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return RoomMesh(
        corners=corners,
        normals=normals.astype(np.float32),
        uv=np.zeros((count, 3, 2), np.float32) if uv is None else uv.astype(np.float32),
        layer=np.zeros(count, np.int32),
        tint=np.broadcast_to(np.float32(tint), (count, 3)),
        direct=np.broadcast_to(np.float32(direct), (count, 3)),
        ambient=np.broadcast_to(np.float32(ambient), (count, 3, 3)),
        textures=textures,
        lamp=np.float32(LAMP),
    )


def make_person(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    uv: np.ndarray | None = None,
    atlas: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    cutout: bool = False,
) -> Character:
    """A mesh that hangs on the root joint of the body that ships."""
    body = default_body()
    weights = np.zeros((len(vertices), len(body.parents)), np.float32)
    weights[:, 0] = 1
    if atlas is None:
        atlas = np.full((16, 16, 4), 255, np.uint8)
    up = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    return Character(
        name="mesh",
        vertices=np.asarray(vertices, np.float32),
        normals=up if normals is None else np.asarray(normals, np.float32),
        faces=np.asarray(faces, np.int32),
        uv=np.zeros((len(vertices), 2), np.float32) if uv is None else np.asarray(uv, np.float32),
        weights=weights,
        cutout=np.full(len(faces), cutout),
        cloth=np.zeros(len(vertices), np.float32),
        atlas=atlas,
        body=body,
    )


def bones(translation: np.ndarray | tuple = (0, 0, 0), times: int = 1) -> torch.Tensor:
    """All bones shifted alike."""
    pose = torch.eye(4).repeat(times, 31, 1, 1)
    pose[..., :3, 3] = torch.as_tensor(np.float32(translation))
    return pose


def front_camera(size: int = 32, focal: float = 32.0) -> Camera:
    """At the origin, looking along +y, z up."""
    rotation = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    pose = torch.eye(4)
    pose[:3, :3] = rotation
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(size, size, intrinsics, pose)


def square(left: float, right: float, bottom: float, top: float, depth: float) -> np.ndarray:
    """Corners of an upright rectangle before `front_camera`, from the top left, clockwise."""
    return np.array(
        [[left, depth, top], [right, depth, top], [right, depth, bottom], [left, depth, bottom]]
    )


TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""u to the right, v down."""
