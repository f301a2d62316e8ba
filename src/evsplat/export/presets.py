"""Poses that an avatar's page can show at once, and joint names that people use."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import Body, BodyTrack, up_axis
from evsplat.body.retarget import smallest_rotation, trunk_axes
from evsplat.body.skeleton import Skeleton, find_skeleton
from evsplat.body.tree import topological_order
from evsplat.errors import DataError

_PLAIN = {
    "collar": "collar bone",
    "upper_arm": "shoulder",
    "forearm": "elbow",
    "hand": "wrist",
    "thigh": "hip",
    "shin": "knee",
    "foot": "ankle",
    "toe": "toes",
}
_ENDS = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}
_DOWN = (0.0, -1.0, 0.0)
_HANGING = (0.15, -1.0, 0.0)
_LEGS = {"thigh": _DOWN, "shin": _DOWN}
# Directions of bones: outward of the trunk to the bone's side, up, ahead.
_POSES: Mapping[str, tuple[Mapping[str, tuple[float, ...]], Mapping[str, tuple[float, ...]]]] = {
    "Wave": (
        {"upper_arm": _HANGING, "forearm": _HANGING, **_LEGS},
        {"upper_arm": (1.0, 0.3, 0.1), "forearm": (0.3, 1.0, 0.1), **_LEGS},
    ),
    "T": ({"upper_arm": (1.0, 0.0, 0.0), "forearm": (1.0, 0.0, 0.0), **_LEGS},) * 2,
    "Sit": (
        {
            "upper_arm": (0.15, -1.0, 0.2),
            "forearm": (0.0, -0.3, 1.0),
            "thigh": (0.15, -0.05, 1.0),
            "shin": _DOWN,
        },
    )
    * 2,
}
"""Of the left and of the right side."""


@dataclass(frozen=True, eq=False)
class Preset:
    """A pose with a name."""

    name: str
    rotations: Float[np.ndarray, "J 3 3"]
    """Against the parent, the root's in the world."""
    transl: Float[np.ndarray, "3"]
    """Root joint's shift from its rest place, metres."""


def joint_labels(body: Body) -> list[str | None]:
    """What people call each joint; None where it has no place in a person's anatomy."""
    labels: list[str | None] = [None] * len(body.parents)
    skeleton = _skeleton(body)
    if skeleton is None:
        return list(body.joint_names)
    labels[skeleton.root] = "Hips"
    for name, joints in (("Spine", skeleton.spine), ("Neck", skeleton.neck[:-1])):
        for number, joint in enumerate(joints, start=1):
            labels[joint] = name if len(joints) == 1 else f"{name} {number}"
    for joint in skeleton.neck[-1:]:
        labels[joint] = "Head"
    for limb, joint in skeleton.limbs.items():
        side, part = limb.split("_", 1)
        labels[joint] = f"{side.capitalize()} {_PLAIN[part]}"
    return labels


def presets(track: BodyTrack, time_us: int) -> list[Preset]:
    """Wave, T and Sit, upright where the person is at a time and facing the same way.

    None for a body whose limbs are not recognised.
    """
    body = track.body.to("cpu")
    skeleton = _skeleton(body)
    if skeleton is None:
        return []
    rest = body.rest_joints.double().numpy()
    axes = trunk_axes(skeleton, rest)
    local, transl = track.at([time_us])
    root = local[0, skeleton.root].cpu().double().numpy()
    up = up_axis(track).double().cpu().numpy()
    upright = smallest_rotation(root @ axes[:, 1], up) @ root
    made = []
    for name, sides in _POSES.items():
        turns = _local(body, skeleton, axes, sides)
        turns[skeleton.root] = upright
        place = transl[0].cpu().double().numpy()
        # The feet stay at the height that they have at rest below a standing person.
        joints = _joints(body, turns, place)
        feet = [skeleton.limbs[f"{side}_foot"] for side in ("left", "right")]
        standing = _joints(body, _only_root(turns, skeleton.root), place)
        place = place - min((joints[feet] - standing[feet]) @ up) * up
        made.append(Preset(name, turns, place))
    return made


def _skeleton(body: Body) -> Skeleton | None:
    try:
        return find_skeleton(body.parents.tolist(), body.joint_names)
    except DataError:
        return None


def _local(
    body: Body,
    skeleton: Skeleton,
    axes: Float[np.ndarray, "3 3"],
    sides: tuple[Mapping[str, tuple[float, ...]], ...],
) -> Float[np.ndarray, "J 3 3"]:
    """Rotations against the parents that bring the bones into the given directions."""
    rest = body.rest_joints.double().numpy()
    parents = body.parents.tolist()
    turned = {}
    for side, sign, directions in zip(("left", "right"), (1, -1), sides, strict=True):
        for part, direction in directions.items():
            joint = skeleton.limbs[f"{side}_{part}"]
            end = skeleton.limbs[f"{side}_{_ENDS[part]}"]
            wanted = axes @ (np.array(direction) * [sign, 1, 1])
            turned[joint] = smallest_rotation(_unit(rest[end] - rest[joint]), _unit(wanted))
        turned[skeleton.limbs[f"{side}_foot"]] = np.eye(3)
    local = np.tile(np.eye(3), (len(parents), 1, 1))
    world: dict[int, np.ndarray] = {}
    for joint in topological_order(parents):
        above = world[parents[joint]] if parents[joint] >= 0 else np.eye(3)
        world[joint] = turned.get(joint, above)
        local[joint] = above.T @ world[joint]
    return local


def _joints(
    body: Body, rotations: Float[np.ndarray, "J 3 3"], transl: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "J 3"]:
    frames = body.joint_transforms(
        torch.from_numpy(rotations).float(), torch.from_numpy(transl).float()
    )
    return frames[:, :3, 3].double().numpy()


def _only_root(rotations: Float[np.ndarray, "J 3 3"], root: int) -> Float[np.ndarray, "J 3 3"]:
    plain = np.tile(np.eye(3), (len(rotations), 1, 1))
    plain[root] = rotations[root]
    return plain


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def quaternions_of(rotations: Float[np.ndarray, "J 3 3"]) -> list[list[float]]:
    """(w, x, y, z) of each."""
    turned = Rotation.from_matrix(rotations).as_quat()
    return [[float(value) for value in row] for row in turned[:, [3, 0, 1, 2]]]
