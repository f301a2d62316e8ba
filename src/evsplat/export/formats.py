"""Files of Gaussians that other programs read: .ply, .splat, .spz and .glb."""

import gzip
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from evsplat.errors import DataError
from evsplat.export.cloud import SplatCloud
from evsplat.files import write_bytes
from evsplat.models.networks.spherical_harmonics import SH_CONSTANT
from evsplat.pictures.light import decode

_LEAST_OPACITY = 1e-6
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""
_SPLAT_ROW = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)
_SPZ_MAGIC, _SPZ_VERSION = 0x5053474E, 3
_SPZ_COORDINATE_BITS, _SPZ_MOST_FRACTIONAL_BITS, _SPZ_MAGNITUDE_BITS = 24, 20, 9
_SPZ_COLOUR_SCALE = 0.15
_GLTF_EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_GLTF_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_ply(path: Path | str, cloud: SplatCloud, *, comments: Sequence[str] = ()) -> None:
    """Write the .ply of Kerbl et al. 2023 (SH degree 0), then columns ``semantic`` and ``seen``.

    All is float32. Normals are zero, ``opacity`` is a logit, ``scale_*`` are natural logarithms of
    metres and ``rot_*`` is (w, x, y, z). ``comments`` become comment lines of the header.
    """
    opacity = np.clip(cloud.opacities.astype(np.float64), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = {
        **dict(zip("xyz", cloud.means.T, strict=True)),
        **{name: np.zeros(len(cloud)) for name in ("nx", "ny", "nz")},
        **{f"f_dc_{k}": (cloud.rgb[:, k] - 0.5) / SH_CONSTANT for k in range(3)},
        "opacity": np.log(opacity / (1 - opacity)),
        **{f"scale_{k}": np.log(cloud.scales[:, k]) for k in range(3)},
        **{f"rot_{k}": cloud.quaternions[:, k] for k in range(4)},
        "semantic": cloud.semantic,
        "seen": cloud.seen,
    }
    table = np.stack([np.float32(values) for values in columns.values()], axis=1)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(cloud)}",
        *(f"property float {name}" for name in columns),
        "end_header\n",
    ]
    write_bytes(path, "\n".join(header).encode("ascii") + table.astype("<f4").tobytes())


def write_splat(path: Path | str, cloud: SplatCloud) -> None:
    """Write the .splat of the first WebGL viewers: 32 bytes per Gaussian, no header.

    Centres and scales are float32, sRGB, opacity and rotation (w, x, y, z) 8 bits. The largest and
    most opaque Gaussians come first, so that a viewer which draws while it loads shows the outline
    early (antimatter15/splat).
    """
    rows = np.zeros(len(cloud), dtype=_SPLAT_ROW)
    rows["mean"], rows["scale"] = cloud.means, cloud.scales
    rgba = np.concatenate([cloud.rgb, cloud.opacities[:, None]], axis=1)
    rows["rgba"] = np.rint(rgba.clip(0, 1) * 255)
    rows["rotation"] = np.rint(cloud.quaternions * 128 + 128).clip(0, 255)
    weight = cloud.opacities * cloud.scales.astype(np.float64).prod(1)
    write_bytes(path, rows[np.argsort(-weight, kind="stable")].tobytes())


def write_spz(path: Path | str, cloud: SplatCloud) -> None:
    """Write Niantic's .spz, version 3, SH degree 0: 20 bytes per Gaussian, gzipped.

    ``cloud`` must be in the format's axes (x right, y up, z back). Precision: centres by the finest
    power of two that holds all of them (1 micrometre where all lie within 8 metres of the origin),
    scales 3 %, rotations 0.2 degrees, opacity and colour 8 bits; colour from -0.44 to 1.44 of the
    sRGB range.
    """
    reach = float(np.abs(cloud.means).max(initial=0.0))
    bits = _fractional_bits(reach)
    if bits < 0:
        raise DataError(
            f"{path}: a Gaussian lies {reach:g} m from the origin; an .spz file holds coordinates "
            "up to 8388 km. Export the person alone with --parts human, or write a .ply."
        )
    f_dc = (cloud.rgb - 0.5) / SH_CONSTANT
    parts = (
        _fixed_point(cloud.means, bits),
        _bytes(cloud.opacities * 255),
        _bytes(f_dc * (_SPZ_COLOUR_SCALE * 255) + 0.5 * 255),
        _bytes((np.log(cloud.scales) + 10) * 16),
        _smallest_three(cloud.quaternions),
    )
    header = struct.pack("<IIIBBBB", _SPZ_MAGIC, _SPZ_VERSION, len(cloud), 0, bits, 0, 0)
    content = header + b"".join(part.tobytes() for part in parts)
    write_bytes(path, gzip.compress(content, mtime=0))


def _fractional_bits(reach: float) -> int:
    """Bits behind the point of a signed 24-bit number that holds ``reach``."""
    largest = 2 ** (_SPZ_COORDINATE_BITS - 1) - 1
    for bits in range(_SPZ_MOST_FRACTIONAL_BITS, -1, -1):
        if reach * 2**bits <= largest:
            return bits
    return -1


def _fixed_point(values: Float32[np.ndarray, "N 3"], bits: int) -> UInt8[np.ndarray, "N 9"]:
    numbers = np.rint(values.astype(np.float64) * 2**bits).astype("<i4")
    return np.ascontiguousarray(numbers.view("u1").reshape(len(values), 3, 4)[..., :3])


def _smallest_three(quaternions: Float32[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """The three smaller of (x, y, z, w), 10 bits each (sign and magnitude), and which is missing.

    The largest is made positive, so that it follows from the others.
    """
    xyzw = quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(1)
    rows = np.arange(len(xyzw))
    xyzw = np.where(xyzw[rows, largest][:, None] < 0, -xyzw, xyzw)
    word = largest.astype(np.uint32)
    steps = 2**_SPZ_MAGNITUDE_BITS - 1
    for axis in range(4):
        value = xyzw[:, axis]
        magnitude = np.floor(steps * np.abs(value) * np.sqrt(2) + 0.5).astype(np.uint32)
        stored = (value < 0).astype(np.uint32) << _SPZ_MAGNITUDE_BITS | magnitude.clip(max=steps)
        word = np.where(largest == axis, word, word << (_SPZ_MAGNITUDE_BITS + 1) | stored)
    return word.astype("<u4").view("u1").reshape(-1, 4)


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def write_gltf(
    path: Path | str, cloud: SplatCloud, *, extras: Mapping[str, Any] | None = None
) -> None:
    """Write binary glTF 2.0 (.glb) with KHR_gaussian_splatting: a point primitive.

    ``cloud`` must be in its axes: metres, +Y up. Kernel ``ellipse``, colour space
    ``srgb_rec709_display``, SH degree 0; scales are linear, as in the release candidate of the
    extension. ``COLOR_0`` (linear light) lets programs that do not know the extension show points;
    ``_SEMANTIC`` is 1 for the person. ``extras`` go to the asset.
    """
    # glTF's curve, whatever the capture was blurred with.
    linear = decode(torch.from_numpy(cloud.rgb).clamp(0, 1), "srgb").numpy()
    colour = np.concatenate([linear, cloud.opacities[:, None]], axis=1)
    attributes = {
        "POSITION": cloud.means,
        "COLOR_0": colour,
        f"{_GLTF_EXTENSION}:ROTATION": cloud.quaternions[:, [1, 2, 3, 0]],
        f"{_GLTF_EXTENSION}:SCALE": cloud.scales,
        f"{_GLTF_EXTENSION}:OPACITY": cloud.opacities[:, None].clip(0, 1),
        f"{_GLTF_EXTENSION}:SH_DEGREE_0_COEF_0": (cloud.rgb - 0.5) / SH_CONSTANT,
        "_SEMANTIC": cloud.semantic[:, None],
    }
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    content = b""
    for name, values in attributes.items():
        data = np.ascontiguousarray(values, dtype="<f4").tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": _FLOAT,
            "count": len(cloud),
            "type": _GLTF_TYPES[values.shape[1]],
        }
        if name == "POSITION":
            accessor["min"] = [float(v) for v in values.min(0)]
            accessor["max"] = [float(v) for v in values.max(0)]
        place = {"byteOffset": len(content), "byteLength": len(data)}
        views.append({"buffer": 0, **place, "target": _ARRAY_BUFFER})
        accessors.append(accessor)
        content += data
    primitive = {
        "mode": _POINTS,
        "attributes": {name: number for number, name in enumerate(attributes)},
        "extensions": {
            _GLTF_EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "evsplat", "extras": dict(extras or {})},
        "extensionsUsed": [_GLTF_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "gaussians"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    write_bytes(path, glb_bytes(document, content))


def glb_bytes(document: Mapping[str, Any], content: bytes) -> bytes:
    """Binary glTF 2.0 of a document and its only buffer."""
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", content, b"\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, data: bytes, padding: bytes) -> bytes:
    data += padding * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data
