"""Clothed, textured, rigged people, from ``.npz`` files with a picture of the same name."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from evsplat.body import Body, default_body, make_body
from evsplat.errors import DataError
from evsplat.staging.assets import read_rgba
from evsplat.untrusted.arrays import read_plain_npz

_ARRAYS = {
    "vertices": ("V", 3),
    "faces": ("F", 3),
    "uv": ("V", 2),
    "weights": ("V", "J"),
    "joint_names": ("J",),
    "parents": ("J",),
    "rest_joints": ("J", 3),
}
_OPTIONAL = {"normals": ("V", 3), "cutout": ("F",), "cloth": ("V",), "body_vertices": ("B", 3)}
_PICTURES = (".webp", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class Character:
    """A person to film; metres, at rest, z up, facing -y."""

    name: str
    vertices: Float32[np.ndarray, "V 3"]
    normals: Float32[np.ndarray, "V 3"]
    faces: Int32[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "V 2"]
    """In the atlas, 0 to 1, v down."""
    weights: Float32[np.ndarray, "V J"]
    cutout: Bool[np.ndarray, "F"]
    """Triangles in which the atlas's transparency cuts holes (hair)."""
    cloth: Float32[np.ndarray, "V"]
    """Looseness of each vertex, 0 to 1 (`evsplat.staging.cloth`)."""
    atlas: UInt8[np.ndarray, "H W 4"]
    """sRGB-coded colour and transparency."""
    body: Body
    """The bare body under the clothes, which the capture gets; its joints move the mesh too."""


def load_character(path: Path | str) -> Character:
    """Read a character and its atlas (``.webp``, ``.png`` or ``.jpg`` beside the ``.npz``).

    Arrays: ``vertices (V, 3)``, ``faces (F, 3)``, ``uv (V, 2)``, ``weights (V, J)``,
    ``joint_names``, ``parents`` and ``rest_joints`` of a rig (root first, parents before children);
    optional ``normals (V, 3)``, ``cutout (F,)``, ``cloth (V,)``, and ``body_vertices``: the bare
    body in the topology of the body that ships with evsplat, for rigs of its joints. Without it the
    capture's body is the mesh itself, with the clothes on.

    Raises:
        DataError: a file is missing or an array does not fit.
    """
    path = Path(path)
    arrays = read_plain_npz(path)
    _check(path, arrays)
    names = tuple(str(name) for name in arrays["joint_names"])
    rig = (arrays["parents"], arrays["rest_joints"], names)
    weights = arrays["weights"].astype(np.float32)
    dressed, order = make_body(arrays["vertices"], arrays["faces"], weights, *rig, source=str(path))
    if order != list(range(len(names))):
        raise DataError(f"{path}: parents must stand before their children, the root first.")
    body = dressed
    if "body_vertices" in arrays:
        body = _bare_body(path, arrays["body_vertices"], rig)
    vertices = arrays["vertices"].astype(np.float32)
    faces = arrays["faces"].astype(np.int32)
    normals = arrays.get("normals")
    return Character(
        name=path.stem,
        vertices=vertices,
        normals=(_normals(vertices, faces) if normals is None else normals).astype(np.float32),
        faces=faces,
        uv=arrays["uv"].astype(np.float32),
        weights=dressed.weights.numpy(),
        cutout=arrays.get("cutout", np.zeros(len(faces))).astype(bool),
        cloth=arrays.get("cloth", np.zeros(len(vertices))).astype(np.float32),
        atlas=read_rgba(_atlas_path(path)),
        body=body,
    )


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    missing = [key for key in _ARRAYS if key not in arrays]
    if missing:
        raise DataError(
            f"{path}: {', '.join(missing)} missing, expected {', '.join(_ARRAYS)}; "
            "docs/stage.md describes the file."
        )
    sizes: dict[str, int] = {}
    for key, shape in (_ARRAYS | _OPTIONAL).items():
        if key not in arrays:
            continue
        found, kind = arrays[key].shape, arrays[key].dtype
        what, kinds = ("texts", "US") if key == "joint_names" else ("numbers", "fiub")
        if kind.kind not in kinds:
            raise DataError(f"{path}: {key} is of type {kind}, expected {what}; correct the array.")
        wanted = tuple(sizes.get(side, side) if isinstance(side, str) else side for side in shape)
        if (
            len(found) != len(wanted)
            or 0 in found
            or any(isinstance(w, int) and w != got for w, got in zip(wanted, found, strict=True))
        ):
            raise DataError(
                f"{path}: {key} has shape {found}, expected ({', '.join(map(str, wanted))}); "
                "correct the array."
            )
        sizes |= {s: got for s, got in zip(shape, found, strict=True) if isinstance(s, str)}
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            raise DataError(f"{path}: {key} holds values that are not finite; repair the mesh.")


def _bare_body(
    path: Path, vertices: Float[np.ndarray, "B 3"], rig: tuple[np.ndarray, np.ndarray, tuple]
) -> Body:
    shipped = default_body()
    parents, rest_joints, names = rig
    if len(vertices) != len(shipped.rest_vertices) or names != shipped.joint_names:
        raise DataError(
            f"{path}: body_vertices has {len(vertices)} vertices on {len(names)} joints, expected "
            f"{len(shipped.rest_vertices)} on the joints of the body that ships with evsplat; "
            "leave it out to use the mesh itself."
        )
    faces, weights = shipped.faces.numpy(), shipped.weights.numpy()
    return make_body(vertices, faces, weights, parents, rest_joints, names, source=str(path))[0]


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted; vertices at one place (seams of the atlas) share theirs."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    _, place = np.unique(vertices.round(6), axis=0, return_inverse=True)
    total = np.zeros((place.max() + 1, 3))
    for corner in range(3):
        np.add.at(total, place.ravel()[faces[:, corner]], area)
    normals = total[place.ravel()]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _atlas_path(path: Path) -> Path:
    for suffix in _PICTURES:
        if path.with_suffix(suffix).is_file():
            return path.with_suffix(suffix)
    raise DataError(
        f"{path.with_suffix('.png')}: file not found; put the character's atlas beside its npz "
        f"({', '.join(_PICTURES)})."
    )
