"""A made-up SMPL model (boxes along bones), a person who moves in it, and pictures of them."""

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from evsplat.body.canonical import SMPL_PARENTS
from evsplat.body.smpl_skeleton import approximate_rest_joints

from ..body.helpers import reference_bones

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_TRIANGLES = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))])


@functools.cache
def smpl_like_model() -> dict[str, np.ndarray]:
    """Arrays of an SMPL file: a small box at every joint, a longer one along every bone."""
    rng = np.random.default_rng(7)
    joints = np.zeros((24, 3))
    joints[:22] = approximate_rest_joints("smpl")
    joints[22:] = joints[20:22] + [[0.08, 0, 0], [-0.08, 0, 0]]
    vertices, owners = [], []
    for joint, parent in enumerate(SMPL_PARENTS):
        vertices.append(joints[joint] + 0.06 * _CORNERS)
        owners += 8 * [joint]
        if parent >= 0:
            middle, length = (joints[joint] + joints[parent]) / 2, joints[joint] - joints[parent]
            vertices.append(middle + _CORNERS * np.maximum(np.abs(length), 0.09))
            owners += 8 * [parent]
    template = np.concatenate(vertices)
    weights = np.zeros((len(template), 24))
    weights[np.arange(len(template)), owners] = 1
    regressor = np.zeros((24, len(template)))
    first = 0
    for joint, parent in enumerate(SMPL_PARENTS):
        regressor[joint, first : first + 8] = 1 / 8
        first += 8 if parent < 0 else 16
    directions = 0.002 * rng.normal(size=(len(template), 3, 10))
    directions[..., 0] = 0.05 * template  # taller
    faces = np.concatenate([_TRIANGLES + 8 * box for box in range(len(template) // 8)])
    return {
        "v_template": template,
        "f": faces.astype(np.uint32),
        "weights": weights,
        "shapedirs": directions,
        "posedirs": np.zeros((len(template), 3, 207)),
        "J_regressor": regressor,
        "kintree_table": np.array([SMPL_PARENTS, range(24)]).astype(np.uint32),
    }


def write_smpl(folder: Path, gender: str = "neutral") -> Path:
    """The model as a user would have it: FOLDER/smpl/SMPL_<GENDER>.npz."""
    (folder / "smpl").mkdir(parents=True)
    np.savez(folder / "smpl" / f"SMPL_{gender.upper()}.npz", **smpl_like_model())
    return folder


@dataclass(frozen=True, eq=False)
class Person:
    """Poses by SMPL's rule: the root turns about the pelvis."""

    betas: np.ndarray
    poses: np.ndarray
    """(P, 24, 3), the root's in the world."""
    transl: np.ndarray
    """(P, 3)."""

    @functools.cached_property
    def rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Shaped vertices and joints at rest."""
        model = smpl_like_model()
        vertices = model["v_template"] + model["shapedirs"] @ self.betas
        return vertices, model["J_regressor"] @ vertices

    def vertices(self, index: int) -> np.ndarray:
        """(V, 3) in the world."""
        rest, joints = self.rest
        bones = reference_bones(SMPL_PARENTS, joints, self.poses[index], self.transl[index])
        moved = np.einsum("jrc,vc->vjr", bones[:, :3, :3], rest) + bones[:, :3, 3]
        return np.einsum("vj,vjr->vr", smpl_like_model()["weights"], moved)

    def joints(self, index: int) -> np.ndarray:
        """(24, 3) in the world."""
        rest = self.rest[1]
        bones = reference_bones(SMPL_PARENTS, rest, self.poses[index], self.transl[index])
        return np.einsum("jrc,jc->jr", bones[:, :3, :3], rest) + bones[:, :3, 3]

    def about_origin(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """EasyMocap's Rh and Th of a pose."""
        pelvis = self.rest[1][0]
        turn = Rotation.from_rotvec(self.poses[index, 0])
        return self.poses[index, 0], pelvis + self.transl[index] - turn.apply(pelvis)


def make_person(
    seed: int, frames: int, world_from_camera: np.ndarray | None = None, distance: float = 3.3
) -> Person:
    """Somebody who sways and swings before the camera, upright in the picture."""
    rng = np.random.default_rng(seed)
    world = np.eye(4) if world_from_camera is None else world_from_camera
    phase = np.linspace(0, 2.5, frames)[:, None, None] + rng.uniform(0, 6, (1, 24, 3))
    poses = 0.25 * np.sin(phase) * rng.uniform(0.2, 1, (1, 24, 3))
    upright = Rotation.from_euler("x", np.pi)
    poses[:, 0] = [
        (Rotation.from_matrix(world[:3, :3]) * upright * Rotation.from_rotvec(p)).as_rotvec()
        for p in poses[:, 0]
    ]
    betas = 0.7 * rng.normal(size=10)
    pelvis = Person(betas, poses, np.zeros((frames, 3))).rest[1][0]
    place = np.array([0, -0.02, distance]) + 0.2 * np.sin(phase[:, 1] + [[0, 1, 2]])
    return Person(betas, poses, place @ world[:3, :3].T + world[:3, 3] - pelvis)


@dataclass(frozen=True, eq=False)
class View:
    """A camera in OpenCV's convention (the centre of the first pixel is at 0)."""

    size: tuple[int, int]
    """Width and height."""
    K: np.ndarray
    world_to_camera: np.ndarray
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def pixels(self, points: np.ndarray, *, distorted: bool) -> np.ndarray:
        """Projections by OpenCV."""
        turn = cv2.Rodrigues(self.world_to_camera[:3, :3])[0]
        lens = np.array(self.distortion if distorted else np.zeros(5))
        seen, _ = cv2.projectPoints(points, turn, self.world_to_camera[:3, 3], self.K, lens)
        return seen[:, 0]

    def draw(self, person: Person, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Picture (H, W, 3) and mask (H, W), uint8, of the person before a gradient."""
        width, height = self.size
        scale = 4 if width < 200 else 1
        seen = (self.pixels(person.vertices(index), distorted=True) + 0.5) * scale
        sheet = Image.new("L", (width * scale, height * scale))
        draw = ImageDraw.Draw(sheet)
        for face in smpl_like_model()["f"]:
            draw.polygon([tuple(seen[v]) for v in face], fill=255)
        share = np.asarray(sheet.resize(self.size, Image.Resampling.BOX), dtype=np.float64) / 255
        ramp = np.linspace(40, 160, width)[None, :, None] * np.array([1, 0.8, 0.6])
        picture = ramp * (1 - share[..., None]) + share[..., None] * np.array([220, 90, 60])
        return np.round(picture).astype(np.uint8), np.where(share > 0.5, 255, 0).astype(np.uint8)


def random_rigid(seed: int) -> np.ndarray:
    """Some world in which cameras stand elsewhere than at the origin."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


def turned_around(world_to_camera: np.ndarray, angle: float, distance: float = 3.3) -> np.ndarray:
    """The pose of a camera that looks at the same place from ``angle`` radians to the side."""
    swing = np.eye(4)
    swing[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
    swing[:3, 3] = np.array([0, 0, distance]) - swing[:3, :3] @ np.array([0, 0, distance])
    return swing @ world_to_camera


def save(path: Path, pixels: np.ndarray) -> None:
    """A picture file, with the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **({"quality": 95} if path.suffix == ".jpg" else {}))
