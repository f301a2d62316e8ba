"""Pictures of a person in a room, by the native z-buffer: linear light, no noise."""

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from evsplat.body import Body
from evsplat.body.skeleton import find_skeleton
from evsplat.camera import Camera
from evsplat.compiled import native_for
from evsplat.staging.character import Character
from evsplat.staging.room import Lighting, RoomMesh

STILL_SAMPLES = 4
"""Samples of the room per pixel and axis where the camera stands still: drawn once, kept."""
MOVING_SAMPLES = 2
_GAMMA = 2.2
"""Textures are coded with this power, as the pictures of the capture are."""
_ROOM_LEVELS = 5
# Tiles of an atlas lie side by side: coarser levels would blend one garment into the next.
_ATLAS_LEVELS = 3
_CONTACTS = ("shin", "foot", "toe", "hand")
"""Limbs whose nearness darkens the floor below, besides the root."""


class StageRenderer:
    """Draws one character in one room; pictures do not depend on ``threads``."""

    def __init__(
        self,
        room: RoomMesh,
        character: Character,
        lighting: Lighting | None = None,
        *,
        threads: int | None = None,
    ) -> None:
        self.character = character
        self.threads = threads or torch.get_num_threads()
        lamp = tuple(float(value) for value in room.lamp)
        assert len(lamp) == 5
        self.lighting = lighting or Lighting(lamp=lamp)
        self.contact_joints = _contacts(character.body)
        bones, weights = _sparse(character.weights)
        self._vertices = _floats(character.vertices)[None]
        self._normals = _floats(character.normals)[None]
        self._stage = native_for("Drawing synthetic captures").Stage(
            corners=_floats(room.corners),
            normals=_floats(room.normals),
            uv=_floats(room.uv),
            layer=np.ascontiguousarray(room.layer, np.int32),
            tint=_floats(room.tint),
            direct=_floats(room.direct),
            ambient=_floats(room.ambient),
            room_texture=_pyramid(room.textures, _ROOM_LEVELS),
            faces=np.ascontiguousarray(character.faces, np.int32),
            person_uv=_floats(character.uv),
            cutout=np.ascontiguousarray(character.cutout, np.uint8),
            bones=bones,
            weights=weights,
            contact=self.contact_joints,
            rest_joints=character.body.rest_joints.numpy(),
            atlas=_pyramid(character.atlas[None, ..., :3], _ATLAS_LEVELS),
            alpha=np.ascontiguousarray(character.atlas[..., 3]),
            light=self.lighting.to_native(),
        )

    def draw(
        self,
        camera: Camera,
        bones: Float[torch.Tensor, "T J 4 4"],
        *,
        world_to_camera: Float[np.ndarray, "T 4 4"] | None = None,
        vertices: Float32[np.ndarray, "T V 3"] | None = None,
        normals: Float32[np.ndarray, "T V 3"] | None = None,
        shadows: bool = True,
    ) -> tuple[Float32[np.ndarray, "T H W 3"], Float32[np.ndarray, "T H W"]]:
        """Linear RGB (0 and up, 1 is white) and the person's share of each pixel, T instants.

        ``bones`` move the mesh from rest to the world. ``world_to_camera`` is the camera's pose at
        each instant, where it moves. ``vertices`` and ``normals`` replace the mesh at rest at each
        instant. Without ``shadows`` the person leaves the room's light as it is (but still shades
        itself), so that the scene is truly static.
        """
        moving = world_to_camera is not None
        poses = camera.world_to_camera.numpy()[None] if world_to_camera is None else world_to_camera
        picture = np.empty((len(bones), camera.height, camera.width, 4), np.float32)
        self._stage.draw(
            _floats(camera.K.numpy()),
            _floats(poses),
            _floats(bones.numpy()),
            self._vertices if vertices is None else _floats(vertices),
            self._normals if normals is None else _floats(normals),
            shadows,
            MOVING_SAMPLES if moving else STILL_SAMPLES,
            picture,
            self.threads,
        )
        return picture[..., :3], picture[..., 3]


def _contacts(body: Body) -> np.ndarray:
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    limbs = [joint for name, joint in skeleton.limbs.items() if name.endswith(_CONTACTS)]
    return np.array([skeleton.root, *limbs], np.int32)


def _floats(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)


def _sparse(weights: Float32[np.ndarray, "V J"]) -> tuple[np.ndarray, np.ndarray]:
    """Joint and weight of each influence (V, K), K as many as any vertex has."""
    count = int((weights > 0).sum(1).max())
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :count].astype(np.int32)
    return np.ascontiguousarray(bones), _floats(np.take_along_axis(weights, bones, axis=1))


def _pyramid(
    textures: UInt8[np.ndarray, "L H W 3"], levels: int
) -> list[Float32[np.ndarray, "L h w 3"]]:
    """Linear light of the textures and of their halves, at most ``levels`` while sides are even."""
    pixels = ((np.arange(256) / 255) ** _GAMMA).astype(np.float32)[textures]
    result = [np.ascontiguousarray(pixels)]
    while len(result) < levels and not any(side % 2 for side in pixels.shape[1:3]):
        upper, lower = pixels[:, ::2], pixels[:, 1::2]
        # means of four; `mean` takes four times as long over two axes
        pixels = upper[:, :, ::2] + upper[:, :, 1::2] + lower[:, :, ::2] + lower[:, :, 1::2]
        pixels /= 4
        result.append(pixels)
    return result
