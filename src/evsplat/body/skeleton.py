"""Anatomy of a skeleton's joints: limbs by the names of common rigs, trunk by the tree."""

from collections.abc import Sequence
from dataclasses import dataclass

from evsplat.body.canonical import find_legs, side_and_core
from evsplat.body.tree import joint_depths
from evsplat.errors import DataError

LIMBS = ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")
"""Parts that both sides of every skeleton need; "toe" and "collar" are taken where they exist."""
_ENDINGS = {
    "shin": ("knee", "lowerleg", "leglower", "shin", "calf", "tibia", "leg"),
    "ankle": ("ankle",),
    "foot": ("foot",),
    "toe": ("toebase", "toe", "toes", "ball"),
    "collar": ("clavicle", "collar"),
    "shoulder": ("shoulder",),
    "upper_arm": ("upperarm", "uparm", "humerus", "arm"),
    "forearm": ("forearm", "lowerarm", "elbow", "radius"),
    "wrist": ("wrist",),
    "hand": ("hand",),
}
_BY_ENDING = {ending: part for part, endings in _ENDINGS.items() for ending in endings}


@dataclass(frozen=True)
class Skeleton:
    """Joint indices by anatomical meaning."""

    root: int
    spine: tuple[int, ...]
    """Joints after the root up to the chest, where the arms branch off."""
    neck: tuple[int, ...]
    """Joints after the chest up to the head; may be empty."""
    limbs: dict[str, int]
    """``left_thigh`` and so on: `LIMBS` of both sides, with ``toe`` and ``collar`` where present.

    A limb's joint is where that part begins: ``left_forearm`` is the left elbow.
    """

    @property
    def chest(self) -> int:
        """The joint that carries arms and neck."""
        return self.spine[-1] if self.spine else self.root


def find_skeleton(
    parents: Sequence[int], joint_names: Sequence[str], source: str = "skeleton"
) -> Skeleton:
    """Recognise the joints of SMPL, CMU (bvh, asf), mixamo, Unreal, MakeHuman, DeepMimic ... rigs.

    Raises:
        DataError: a limb is not recognised; the message lists the joints that there are.
    """
    depths = joint_depths(parents, source)
    legs = find_legs(parents, joint_names)
    sided: dict[str, int] = {}
    if legs is not None:
        sided = {"left_thigh": legs.left, "right_thigh": legs.right}
    for joint in sorted(range(len(parents)), key=lambda joint: depths[joint]):
        side, core = side_and_core(joint_names[joint])
        part = _part(core)
        # The shin lies below the thigh: "LeftLeg" may also be the group above it.
        if side and part and (part != "shin" or _below(joint, sided.get(f"{side}_thigh"), parents)):
            sided.setdefault(f"{side}_{part}", joint)
    limbs: dict[str, int] = {}
    for side in ("left", "right"):
        parts = {p: sided[f"{side}_{p}"] for p in (*_ENDINGS, "thigh") if f"{side}_{p}" in sided}
        limbs |= {f"{side}_{part}": joint for part, joint in _resolve(parts, joint_names).items()}
    missing = [f"{side}_{p}" for side in ("left", "right") for p in LIMBS]
    missing = [name for name in missing if name not in limbs]
    if missing:
        raise DataError(
            f"{source}: no joint recognised as {', '.join(missing)} among "
            f"{', '.join(joint_names)}; rename the joints (left_hip, left_knee, left_ankle, "
            "left_shoulder, left_elbow, left_wrist, and right_...)."
        )
    root = depths.index(0)
    arms = [_path(limbs[f"{side}_upper_arm"], parents) for side in ("left", "right")]
    spine = [joint for joint in arms[0] if joint in arms[1]]
    heads = [
        joint
        for joint in range(len(parents))
        if side_and_core(joint_names[joint])[1].endswith(("head", "neck"))
        and spine[-1] in _path(joint, parents)[:-1]
    ]
    heads.sort(key=lambda joint: depths[joint])
    # The head nearest the chest; without one, the last joint of the neck.
    named = [joint for joint in heads if side_and_core(joint_names[joint])[1].endswith("head")]
    top = named[:1] or heads[-1:]
    neck = _path(top[0], parents)[len(spine) :] if top else []
    return Skeleton(root, tuple(spine[1:]), tuple(neck), limbs)


def _part(core: str) -> str | None:
    """The part that a name's ending means; the longest ending wins ("forearm" before "arm")."""
    endings = [ending for ending in _BY_ENDING if core.endswith(ending)]
    if not endings or core.endswith(("upleg", "upperleg")):
        return None
    return _BY_ENDING[max(endings, key=len)]


def _resolve(parts: dict[str, int], joint_names: Sequence[str]) -> dict[str, int]:
    """Give the names whose meaning depends on their neighbours their meaning."""
    parts = dict(parts)
    if "upper_arm" in parts:  # "LeftShoulder, LeftArm": the first is the collar bone
        if "shoulder" in parts:
            parts.setdefault("collar", parts["shoulder"])
    elif "shoulder" in parts:
        parts["upper_arm"] = parts["shoulder"]
    if "ankle" in parts:  # SMPL: "left_ankle, left_foot", the second is the ball of the foot
        if "foot" in parts:
            parts.setdefault("toe", parts["foot"])
        parts["foot"] = parts["ankle"]
    # Acclaim's "wrist" bone only twists the forearm; elsewhere the hand hangs on the wrist.
    acclaim = "forearm" in parts and side_and_core(joint_names[parts["forearm"]])[1] == "radius"
    if "wrist" in parts and not (acclaim and "hand" in parts):
        parts["hand"] = parts["wrist"]
    return {part: parts[part] for part in (*LIMBS, "toe", "collar") if part in parts}


def _path(joint: int, parents: Sequence[int]) -> list[int]:
    """Joints from the root down to ``joint``."""
    path = [joint]
    while parents[path[-1]] >= 0:
        path.append(int(parents[path[-1]]))
    return path[::-1]


def _below(joint: int, ancestor: int | None, parents: Sequence[int]) -> bool:
    return ancestor is not None and ancestor in _path(joint, parents)[:-1]
