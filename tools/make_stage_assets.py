"""Pack characters, room and motions for shipping: `make_stage_assets.py SOURCE CAPTURES`.

SOURCE holds `characters/`, `scene/` and `motions/deepmimic/`; CAPTURES the captures whose bodies
are the characters' bare bodies. Writes to src/evsplat/data/stage. Pictures become WebP, room
corners are indexed, light is stored as half floats.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

TARGET = Path(__file__).parents[1] / "src" / "evsplat" / "data" / "stage"
CHARACTERS = {
    "man": "man_dance_hard_256",
    "woman": "woman_dance_b_256",
    "worker": "worker_punch_256",
}
HAIR = ("short", "afro", "bob", "pony", "long", "braid")
CLOTH = ("suit",)


def main() -> None:
    """Write all assets and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("captures", type=Path)
    arguments = parser.parse_args()
    for folder in ("characters", "motions"):
        (TARGET / folder).mkdir(parents=True, exist_ok=True)
    for name, capture in CHARACTERS.items():
        pack_character(arguments.source / "characters" / name, arguments.captures / capture)
    pack_room(arguments.source / "scene")
    for path in sorted((arguments.source / "motions" / "deepmimic").glob("humanoid3d_*.txt")):
        shutil.copyfile(path, TARGET / "motions" / path.name.removeprefix("humanoid3d_"))
    size = sum(path.stat().st_size for path in TARGET.rglob("*") if path.is_file())
    print(f"{TARGET}: {size / 1e6:.2f} MB")


def pack_character(stem: Path, capture: Path) -> None:
    """One character with its bare body."""
    given = np.load(stem.with_suffix(".npz"))
    body = np.load(capture / "body.npz")
    parts = [str(part) for part in given["part_names"]]
    of_vertex = np.zeros(len(given["verts"]), np.int64)
    of_vertex[given["faces"].ravel()] = np.repeat(given["part"], 3)
    np.savez_compressed(
        TARGET / "characters" / f"{stem.name}.npz",
        vertices=given["verts"],
        normals=(given["normals"]).astype(np.float16),
        faces=given["faces"].astype(np.uint16),
        uv=given["uv"],
        weights=given["weights"].astype(np.float16),
        joint_names=given["joint_names"],
        parents=given["parents"].astype(np.int16),
        rest_joints=given["rest_bone"][:, :3, 3],
        cutout=np.array([part.startswith(HAIR) for part in parts])[given["part"]],
        cloth=np.array([any(word in part for word in CLOTH) for part in parts])[of_vertex],
        body_vertices=body["rest_vertices"],
    )
    with Image.open(stem.with_name(f"{stem.name}_atlas.png")) as atlas:
        atlas.save(TARGET / "characters" / f"{stem.name}.webp", quality=90, method=6, exact=True)


def pack_room(scene: Path) -> None:
    """The room's triangles and its textures, one below the other."""
    given = np.load(scene / "scene.npz")
    vertices, faces = np.unique(given["P"].reshape(-1, 3), axis=0, return_inverse=True)
    np.savez_compressed(
        TARGET / "room.npz",
        vertices=vertices,
        faces=faces.reshape(-1, 3).astype(np.uint16),
        uv=given["uv"],
        layer=given["layer"].astype(np.uint8),
        tint=given["col"].astype(np.float16),
        direct=given["Ed"].astype(np.float16),
        ambient=given["Ea"].astype(np.float16),
        lamp=given["light"],
    )
    textures = np.load(scene / "scene_tex.npz")["textures"]
    strip = Image.fromarray(textures.reshape(-1, textures.shape[2], 3))
    strip.save(TARGET / "room.webp", quality=90, method=6)


if __name__ == "__main__":
    main()
