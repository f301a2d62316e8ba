"""Canonical pose: the shaped rest pose with the legs apart, where a skeleton's legs are found."""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body.rotations import axis_angle_to_matrix

_log = logging.getLogger(__name__)

SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
SMPL_SPREAD_DEG = 45.0
"""Rotation of each leg of the SMPL family (3DGS-Avatar)."""
THIGH_DEG = 30.0
"""Other rigs: angle between thigh and straight down, seen from the front. Their rest poses differ
(A-poses already have the legs apart), so the angle reached is fixed and not the rotation. At 30
degrees the thighs are well apart and the feet about as wide as the hands of an A-pose."""

_THIGH_NAMES = ("upleg", "upperleg", "legupper", "thigh", "femur")
_HIP_NAMES = ("hip", "hipjoint")
_PREFIXED_NAMES = (
    *(*_THIGH_NAMES, *_HIP_NAMES, "tibia", "foot", "toes"),
    *("clavicle", "humerus", "radius", "wrist", "hand"),
)
"""Bones of Acclaim skeletons (CMU), whose names begin with an l or r that nothing sets apart."""
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+")


@dataclass(frozen=True)
class Legs:
    """The two thigh joints: rotating them moves the legs as a whole."""

    left: int
    right: int
    smpl: bool
    """True for a skeleton of the SMPL family."""


def find_legs(parents: Sequence[int], joint_names: Sequence[str]) -> Legs | None:
    """Find the thighs by the joint names of common rigs (SMPL, CMU, Anny, mixamo, Unreal, VRM ...).

    Of several matches on a side the one nearest the root counts. A nameless skeleton of SMPL's
    tree is taken as SMPL. None where no pair with a joint below each is recognised.
    """
    if _is_smpl(parents, joint_names):
        return Legs(1, 2, smpl=True)
    parsed = [side_and_core(name) for name in joint_names]
    for names in (_THIGH_NAMES, _HIP_NAMES):
        found: dict[str, int] = {}
        for joint, (side, core) in enumerate(parsed):
            if side and side not in found and core.endswith(names) and joint in parents:
                found[side] = joint
        if len(found) == 2:
            return Legs(found["left"], found["right"], smpl=False)
    return None


def leg_spread_rotations(
    parents: Sequence[int], rest_joints: Float[Tensor, "J 3"], joint_names: Sequence[str]
) -> Float[Tensor, "J 3 3"]:
    """Local joint rotations that take the rest pose to the canonical pose.

    Each leg turns outward about the body's forward axis: by `SMPL_SPREAD_DEG` in the SMPL family,
    else until the thigh is `THIGH_DEG` from straight down (never inward). Where no legs are
    recognised the rest pose itself is canonical, which is logged once.
    """
    rotations = torch.eye(3, dtype=rest_joints.dtype).repeat(len(parents), 1, 1)
    legs = find_legs(parents, joint_names)
    if legs is None:
        _tell_once(tuple(joint_names))
        return rotations.to(rest_joints.device)
    joints = rest_joints.detach().cpu().double().numpy()
    bones = {joint: _thigh_bone(joint, parents, joints) for joint in (legs.left, legs.right)}
    side = _unit(joints[legs.left] - joints[legs.right])
    down = bones[legs.left] + bones[legs.right]
    down = _unit(down - side * (side @ down))
    forward = np.cross(side, -down)
    for joint, sign in ((legs.left, 1.0), (legs.right, -1.0)):
        if legs.smpl:
            degrees = SMPL_SPREAD_DEG
        else:
            outward = np.degrees(np.arctan2(bones[joint] @ (sign * side), bones[joint] @ down))
            degrees = max(0.0, THIGH_DEG - float(outward))
        turn = torch.from_numpy(forward * sign * np.radians(degrees))
        rotations[joint] = axis_angle_to_matrix(turn).to(rotations)
    return rotations.to(rest_joints.device)


@cache
def _tell_once(joint_names: tuple[str, ...]) -> None:
    """A run makes the same body several times: trained, evaluated, drawn."""
    _log.warning(
        "No legs recognised among joints %s ...: the rest pose is the canonical pose.",
        ", ".join(joint_names[:6]),
    )


def _is_smpl(parents: Sequence[int], joint_names: Sequence[str]) -> bool:
    """SMPL, SMPL-H and SMPL-X share the joints 0..21 and their order."""
    if tuple(parents[:22]) != SMPL_PARENTS[:22]:
        return False
    named = [side_and_core(name) for name in joint_names[1:3]]
    nameless = len(parents) == len(SMPL_PARENTS) and all(side is None for side, _ in named)
    return nameless or named == [("left", "hip"), ("right", "hip")]


def side_and_core(name: str) -> tuple[str | None, str]:
    """Side and lower-case rest of a name: 'mixamorig:LeftUpLeg' -> ('left', 'mixamorigupleg')."""
    words = [word.lower() for word in _WORD.findall(name)]
    sides = [_SIDES[word] for word in words if word in _SIDES]
    core = "".join(word for word in words if word not in _SIDES)
    if not sides and core[:1] in _SIDES and core[1:] in _PREFIXED_NAMES:
        return _SIDES[core[0]], core[1:]  # 'lfemur'
    return (sides[0] if len(set(sides)) == 1 else None), core


def _thigh_bone(thigh: int, parents: Sequence[int], joints: np.ndarray) -> np.ndarray:
    """Unit vector along the thigh, towards its farthest child (twist joints lie nearer)."""
    children = [joint for joint, parent in enumerate(parents) if parent == thigh]
    bones = [joints[child] - joints[thigh] for child in children]
    return _unit(max(bones, key=np.linalg.norm))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
