"""The furnished room: triangles with textures and baked light."""

from dataclasses import dataclass
from importlib.resources import as_file, files

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from evsplat.capture.body_file import read_arrays
from evsplat.staging.textures import read_rgba


@dataclass(frozen=True, eq=False)
class Room:
    """Surfaces and the light that falls on them; metres, z up, the floor at z = 0."""

    corners: Float32[np.ndarray, "F 3 3"]
    normals: Float32[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "F 3 2"]
    """Textures repeat."""
    layer: Int32[np.ndarray, "F"]
    """Which of the textures."""
    tint: Float32[np.ndarray, "F 3"]
    """Colour that multiplies the texture."""
    direct: Float32[np.ndarray, "F 3"]
    """Light of the lamp at each corner, with the furniture's shadows."""
    ambient: Float32[np.ndarray, "F 3 3"]
    """Light from elsewhere at each corner, RGB."""
    textures: UInt8[np.ndarray, "L S S 3"]
    """sRGB-coded squares."""
    lamp: Float32[np.ndarray, "5"]
    """Centre of the ceiling lamp and half its extent along x and y."""


def load_room() -> Room:
    """The room that ships with evsplat."""
    folder = files("evsplat") / "data" / "stage"
    with as_file(folder / "room.npz") as path:
        arrays = read_arrays(path)
    with as_file(folder / "room.webp") as path:
        strip = read_rgba(path)[..., :3]
    side = strip.shape[1]
    triangles = _decode(arrays)
    return Room(
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
