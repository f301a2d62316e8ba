"""The furnished room, its lamp, and the light that skin and cloth answer to."""

from dataclasses import dataclass
from importlib.resources import as_file, files

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from evsplat.compiled import native
from evsplat.staging.assets import read_rgba
from evsplat.staging.camera import look_at
from evsplat.untrusted.arrays import read_plain_npz

_SHADOW_TEXELS = 640
_SHADOW_FOCAL = 1 / 2.9
"""Focal length of the shadow map over its side: 55 degrees to either side of its middle."""
_SHADOW_SOFTNESS = 0.016
"""Radius of the soft edge over the side of the shadow map."""
_LEAN = (-0.12, 0.22, -1.0)
"""The shadow map looks a little towards the middle of the room."""


@dataclass(frozen=True)
class Lighting:
    """Radiances relative to the room's baked light."""

    lamp: tuple[float, float, float, float, float]
    """Centre of a flat lamp (metres) and half its extent along its sides, which are x and y where
    it shines down."""
    lamp_strength: float = 3.0
    facing: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """The way that the lamp shines, of length 1."""
    shadow_way: tuple[float, float, float] = _LEAN
    """The way that the shadow map looks; it sees 55 degrees to either side."""
    ambient_below: tuple[float, float, float] = (0.17, 0.15, 0.135)
    """Light from all around on what faces down."""
    ambient_above: tuple[float, float, float] = (0.24, 0.245, 0.25)
    """Light from all around on what faces up."""
    rim: float = 0.05
    """Light that comes from beside the camera."""
    wrap: float = 0.15
    """Reach of lamp light round an edge, 0 to 1."""
    specular: float = 0.04
    shininess: float = 24.0
    shadow_bias_m: float = 0.03

    def shadow_view(self) -> Float[np.ndarray, "3 4"]:
        """World to the lamp's eye: x and y across, z away from the lamp."""
        eye = np.array(self.lamp[:3])
        return look_at(eye, eye + np.array(self.shadow_way), up=(0, 1, 0))[:3]

    @property
    def power(self) -> float:
        """Light at 1 m straight before the lamp, on what faces it."""
        return 4 * self.lamp[3] * self.lamp[4] / np.pi * self.lamp_strength

    def to_native(self) -> "native.Light":
        """Light as the renderer takes it."""
        light = native.Light()
        light.position, light.facing = self.lamp[:3], self.facing
        light.power = self.power
        light.world_to_light = self.shadow_view().ravel().tolist()
        light.shadow_size = _SHADOW_TEXELS
        light.shadow_focal = _SHADOW_TEXELS * _SHADOW_FOCAL
        light.shadow_radius = _SHADOW_TEXELS * _SHADOW_SOFTNESS
        light.shadow_bias = self.shadow_bias_m
        light.ambient_below, light.ambient_above = self.ambient_below, self.ambient_above
        light.rim, light.wrap = self.rim, self.wrap
        light.specular, light.shininess = self.specular, self.shininess
        return light


@dataclass(frozen=True, eq=False)
class RoomMesh:
    """Surfaces and the light that falls on them; metres, z up, the floor at z = 0."""

    corners: Float32[np.ndarray, "F 3 3"]
    normals: Float32[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "F 3 2"]
    """Place in the texture, which repeats."""
    layer: Int32[np.ndarray, "F"]
    """Index of the texture."""
    tint: Float32[np.ndarray, "F 3"]
    """Colour that multiplies the texture."""
    direct: Float32[np.ndarray, "F 3"]
    """Light of the lamp at each corner, with the furniture's shadows."""
    ambient: Float32[np.ndarray, "F 3 3"]
    """Light from elsewhere at each corner, RGB."""
    textures: UInt8[np.ndarray, "L S S 3"]
    """Square textures, sRGB-coded."""
    lamp: Float32[np.ndarray, "5"]
    """Centre of the ceiling lamp and half its extent along x and y."""


def load_room() -> RoomMesh:
    """The room that ships with evsplat."""
    folder = files("evsplat") / "data" / "stage"
    with as_file(folder / "room.npz") as path:
        arrays = read_plain_npz(path)
    with as_file(folder / "room.webp") as path:
        strip = read_rgba(path)[..., :3]
    side = strip.shape[1]
    triangles = _decode(arrays)
    return RoomMesh(
        **triangles,
        layer=arrays["layer"].astype(np.int32),
        textures=strip.reshape(-1, side, side, 3),
        lamp=arrays["lamp"].astype(np.float32),
    )


def _decode(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Indexed corners become one per triangle; light comes as half floats, tints as bytes."""
    corners = arrays["vertices"][arrays["faces"]].astype(np.float32)
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(*edges)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return {
        "corners": corners,
        "normals": normals.astype(np.float32),
        "uv": arrays["uv"].astype(np.float32),
        "tint": arrays["tint"].astype(np.float32),
        "direct": arrays["direct"].astype(np.float32),
        "ambient": arrays["ambient"].astype(np.float32),
    }
