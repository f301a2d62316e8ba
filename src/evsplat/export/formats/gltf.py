"""glTF 2.0 with KHR_gaussian_splatting: a point primitive whose attributes are Gaussians."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evsplat.export.cloud import SplatCloud
from evsplat.export.formats.ply import SH_C0
from evsplat.files import atomic_path
from evsplat.pictures.light import decode

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(
    path: Path | str, cloud: SplatCloud, *, extras: Mapping[str, Any] | None = None
) -> None:
    """Write ``path`` as binary glTF (.glb); ``cloud`` must be in its axes: metres, +Y up.

    Kernel ``ellipse``, colour space ``srgb_rec709_display``, SH degree 0; scales are linear, as in
    the release candidate of the extension. ``COLOR_0`` (linear light) lets programs that do not
    know the extension show points; ``_SEMANTIC`` is 1 for the person. ``extras`` go to the asset.
    """
    # glTF's curve, whatever the capture was blurred with.
    linear = decode(torch.from_numpy(cloud.rgb).clamp(0, 1), "srgb").numpy()
    colour = np.concatenate([linear, cloud.opacities[:, None]], axis=1)
    attributes = {
        "POSITION": cloud.means,
        "COLOR_0": colour,
        f"{EXTENSION}:ROTATION": cloud.quaternions[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": cloud.scales,
        f"{EXTENSION}:OPACITY": cloud.opacities[:, None].clip(0, 1),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (cloud.rgb - 0.5) / SH_C0,
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
            "type": _TYPES[values.shape[1]],
        }
        if name == "POSITION":
            accessor["min"] = [float(v) for v in values.min(0)]
            accessor["max"] = [float(v) for v in values.max(0)]
        views.append(
            {
                "buffer": 0,
                "byteOffset": len(content),
                "byteLength": len(data),
                "target": _ARRAY_BUFFER,
            }
        )
        accessors.append(accessor)
        content += data
    primitive = {
        "mode": _POINTS,
        "attributes": {name: number for number, name in enumerate(attributes)},
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "evsplat", "extras": dict(extras or {})},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "gaussians"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", content, b"\0")
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _chunk(kind: bytes, data: bytes, padding: bytes) -> bytes:
    data += padding * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data
