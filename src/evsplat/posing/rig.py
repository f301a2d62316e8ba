"""Skeletons to be fitted: their degrees of freedom, and where landmarks sit on them.

The joints of any body are turned as those of the body that ships would be (`Rig.frames`), so that
the pose prior and the offsets of landmarks, which were learned on that body, serve all bodies.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from evsplat.body import Body, default_body, nearest_axis
from evsplat.body.retarget import alignments, rest_from_zero, trunk_axes
from evsplat.body.rotations import axis_angle_to_matrix, nearest_axis_angle
from evsplat.body.skeleton import Skeleton, find_skeleton
from evsplat.errors import DataError
from evsplat.untrusted.text import read_json

_SIDED = ("thigh", "shin", "foot", "collar", "upper_arm", "forearm", "hand")
ROWS = tuple(f"{s}_{part}" for part in _SIDED for s in ("left", "right")) + ("spine", "neck")
"""Parts that turn, three numbers each; spine and neck are chains that bend evenly."""
LIMBS = {
    f"{side}_{limb}": tuple(f"{side}_{part}" for part in parts)
    for side in ("left", "right")
    for limb, parts in (("leg", ("thigh", "shin", "foot")), ("arm", ("upper_arm", "forearm")))
}
"""Limbs by the parts that make them."""
_CHAIN = 3
"""Joints in spine and neck of the body that ships, over which their bend was learned."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A body's tree with bones in the frames of the body that ships; float64, metres.

    J joints, B shape coefficients.
    """

    body: Callable[[Float[np.ndarray, "B"]], Body]
    """The shaped body of given coefficients."""
    model: str
    """Its name in ``body.npz``."""
    skeleton: Skeleton
    parents: tuple[int, ...]
    rest: Float[Tensor, "J 3"]
    """Rest joints of the mean shape, in the body's own axes."""
    bones: Float[Tensor, "J 3"]
    """From the parent's joint to the own at the mean shape, in the parent's frame."""
    bone_directions: Float[Tensor, "B J 3"]
    frames: Float[Tensor, "J 3 3"]
    """World rotation of a joint of the body = that of the body that ships times this."""
    row: Int64[Tensor, "J"]
    """Index into `ROWS` of what turns a joint; -1 for the root and for joints that stay at rest."""
    share: Float[Tensor, "J"]
    """Share of its row's vector that a joint turns by."""
    stature: float
    """Crown to sole at rest of the mean shape."""
    growth: Float[Tensor, "B"]
    """Change of the stature per coefficient."""

    def joint(self, name: str) -> int:
        """Index of the joint of a part: of `ROWS`' limbs, "neck", "head", "root", "chest"."""
        skeleton = self.skeleton
        if name in skeleton.limbs:
            return skeleton.limbs[name]
        neck = skeleton.neck or (skeleton.chest,)
        middle = {"root": skeleton.root, "chest": skeleton.chest, "neck": neck[0], "head": neck[-1]}
        return middle[name]

    def poses(
        self, root: Float[Tensor, "T 3 3"], rows: Float[Tensor, "T R 3"]
    ) -> Float[np.ndarray, "T J 3"]:
        """Axis-angle poses of the body, each near that of the time before."""
        local = local_rotations(self, root, rows)
        frames = self.frames
        above = frames[[max(p, 0) for p in self.parents]].clone()
        above[0] = torch.eye(3, dtype=torch.float64)
        own = (above.mT @ local @ frames).reshape(-1, 3, 3).numpy()
        vectors = Rotation.from_matrix(own).as_rotvec()
        return nearest_axis_angle(vectors.reshape(len(rows), -1, 3))


def local_rotations(
    rig: Rig, root: Float[Tensor, "T 3 3"], rows: Float[Tensor, "T R 3"]
) -> Float[Tensor, "T J 3 3"]:
    """Rotation of each joint relative to its parent, in the frames of the body that ships."""
    turned = rows[:, rig.row.clamp_min(0)] * rig.share[:, None]
    turned = torch.where((rig.row >= 0)[:, None], turned, torch.zeros_like(turned))
    local = axis_angle_to_matrix(turned)
    return torch.cat((root[:, None], local[:, 1:]), 1)


def make_rig(body: Callable[[Float[np.ndarray, "B"]], Body], model: str, coefficients: int) -> Rig:
    """The rig of a body with a number of shape coefficients, in which its joints are linear."""
    mean = body(np.zeros(coefficients))
    rest = mean.rest_joints.double().numpy()
    parents = tuple(mean.parents.tolist())
    skeleton = find_skeleton(parents, mean.joint_names, model)
    # Arms that are held out reach farther than a person is tall.
    up = nearest_axis(torch.from_numpy(trunk_axes(skeleton, rest)[:, 1])).double().numpy()
    shaped = [body(one) for one in np.eye(coefficients)]
    directions = np.stack([one.rest_joints.double().numpy() - rest for one in shaped])
    height = mean.rest_vertices.double().numpy() @ up
    ends = int(height.argmax()), int(height.argmin())
    growth = []
    for one in shaped:
        grown = one.rest_vertices.double().numpy() @ up
        growth.append(grown[ends[0]] - grown[ends[1]] - (height[ends[0]] - height[ends[1]]))
    frames = _frames(skeleton, rest, parents)
    above = [max(parent, 0) for parent in parents]
    to_parent = frames[above]
    bones = np.einsum("jab,jb->ja", to_parent, rest - rest[above])
    bent = np.einsum("jab,sjb->sja", to_parent, directions - directions[:, above])
    row, share = _row_of_joints(skeleton, len(parents))
    return Rig(
        body=body,
        model=model,
        skeleton=skeleton,
        parents=parents,
        rest=torch.from_numpy(rest),
        bones=torch.from_numpy(bones),
        bone_directions=torch.from_numpy(bent),
        frames=torch.from_numpy(frames),
        row=row,
        share=share,
        stature=float(height[ends[0]] - height[ends[1]]),
        growth=torch.tensor(growth, dtype=torch.float64),
    )


@cache
def default_rig() -> Rig:
    """The rig of the body that ships, with its 10 coefficients."""
    return make_rig(default_body, "default", 10)


@dataclass(frozen=True, eq=False)
class Attachments:
    """Places of L landmarks on a rig: at a joint, and an offset in the frame of another."""

    index: Int64[Tensor, "L"]
    """Index among the landmarks given; those that sit nowhere on a body are left out."""
    origin: Int64[Tensor, "L"]
    turner: Int64[Tensor, "L"]
    offset: Float[Tensor, "L 3"]
    """Metres, in the frame of ``turner``."""
    trust: Float[Tensor, "L"]
    """Weight: many landmarks of one face count as a few."""


_FACE_TRUST = 0.35
_JOINTS = {
    **{"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand"},
    **{"hip": "thigh", "knee": "shin", "ankle": "foot"},
}
"""Landmarks that other detectors put on the joint itself."""
_MIDDLE = {"neck": "neck", "mid_hip": "root", "pelvis": "root"}
_ALIAS = {"big_toe": "foot_index"}
_BLAZEPOSE_ONLY = "left_foot_index"


def attach(rig: Rig, names: Sequence[str]) -> Attachments:
    """Where landmarks of the given names sit.

    BlazePose's points keep a learned distance from the joints that they are named after; those of
    other detectors are taken to lie in the joints of arms and legs.

    Raises:
        DataError: fewer than eight of the names are known.
    """
    learned = blazepose_offsets()
    blazepose = _BLAZEPOSE_ONLY in names
    found: list[tuple[int, int, int, tuple[float, float, float], float]] = []
    for index, name in enumerate(names):
        side, _, core = name.partition("_")
        if not blazepose and side in ("left", "right") and core in _JOINTS:
            joint = rig.joint(f"{side}_{_JOINTS[core]}")
            found.append((index, joint, joint, (0.0, 0.0, 0.0), 1.0))
        elif not blazepose and name in _MIDDLE:
            joint = rig.joint(_MIDDLE[name])
            found.append((index, joint, joint, (0.0, 0.0, 0.0), 1.0))
        else:
            known = f"{side}_{_ALIAS[core]}" if core in _ALIAS else name
            if known in learned:
                origin, turner, offset = learned[known]
                trust = _FACE_TRUST if origin == "head" else 1.0
                found.append((index, rig.joint(origin), rig.joint(turner), offset, trust))
    if len(found) < 8:
        raise DataError(
            f"landmarks: {len(found)} of the names {', '.join(names)} are known, expected at least "
            "8; name them as BlazePose, COCO or OpenPose do (left_shoulder, right_knee, ...)."
        )
    return Attachments(
        index=torch.tensor([row[0] for row in found]),
        origin=torch.tensor([row[1] for row in found]),
        turner=torch.tensor([row[2] for row in found]),
        offset=torch.tensor([row[3] for row in found], dtype=torch.float64),
        trust=torch.tensor([row[4] for row in found], dtype=torch.float64),
    )


@cache
def blazepose_offsets() -> dict[str, tuple[str, str, tuple[float, float, float]]]:
    """Landmark to (part at whose joint it sits, part whose frame turns it, offset in metres).

    Learned by tools/learn_posing.py, which says from what.
    """
    resource = files("evsplat") / "data" / "posing" / "blazepose.json"
    rows = read_json(Path(str(resource)))["offsets"]
    return {name: (row[0], row[1], tuple(row[2])) for name, row in rows.items()}


def _row_of_joints(skeleton: Skeleton, count: int) -> tuple[Tensor, Tensor]:
    row, share = torch.full((count,), -1), torch.ones(count, dtype=torch.float64)
    for name, joint in skeleton.limbs.items():
        if name in ROWS:
            row[joint] = ROWS.index(name)
    for name, chain in (("spine", skeleton.spine), ("neck", skeleton.neck)):
        for joint in chain:
            row[joint], share[joint] = ROWS.index(name), _CHAIN / len(chain)
    return row, share


def _frames(skeleton: Skeleton, rest: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """`Rig.frames`: identities for the body that ships itself."""
    shipped = default_body()
    mover = find_skeleton(shipped.parents.tolist(), shipped.joint_names)
    zero = shipped.rest_joints.double().numpy()
    upright = rest_from_zero(mover, zero, skeleton, rest)
    aligned = alignments(mover, zero @ upright.T, skeleton, rest)
    # Joints that stay at rest relative to their parent share its frame.
    moved = {skeleton.root, *skeleton.spine, *skeleton.neck, *skeleton.limbs.values()}
    frames = np.empty_like(aligned)
    for joint, parent in enumerate(parents):
        frames[joint] = upright.T @ aligned[joint] if joint in moved else frames[parent]
    return frames
