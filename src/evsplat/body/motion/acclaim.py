"""Acclaim skeletons and motions (``.asf``, ``.amc``), the format of CMU's motion capture."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.body.motion.limits import check_extent
from evsplat.body.retarget import SkeletonMotion
from evsplat.body.tree import world_rotations
from evsplat.errors import DataError
from evsplat.untrusted.text import read_text

FRAME_RATE_HZ = 120.0
"""CMU's; the files do not say."""
_METRES = 0.0254
"""CMU's lengths are inches once divided by the skeleton's unit."""
_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from x left, y up, z forward to z up, facing -y."""
_TURNS = ("rx", "ry", "rz")
_ROOT = ("tx", "ty", "tz", *_TURNS)
"""What the root has numbers for, in this order."""


@dataclass
class _Bone:
    name: str
    parent: int
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: np.ndarray = field(default_factory=lambda: np.eye(3))
    turns: tuple[str, ...] = ()


def read_acclaim(path: Path, skeleton: Path) -> SkeletonMotion:
    """The motion ``path`` (.amc) of the skeleton ``skeleton`` (.asf), 120 frames a second.

    A joint is where its bone begins. Angles are about x, then y, then z; in degrees, unless the
    files say radians.
    """
    bones, unit, degrees = _read_skeleton(skeleton)
    frames, degrees = _read_frames(path, degrees)
    count = len(frames)
    check_extent(path, count, len(bones))
    local = np.tile(np.eye(3), (count, len(bones), 1, 1))
    ends, zero = np.zeros((len(bones), 3)), np.zeros((len(bones), 3))
    positions = np.zeros((count, 3))
    for index, bone in enumerate(bones):
        values = _values(path, frames, bone, 6 if bone.parent < 0 else len(bone.turns))
        if bone.parent < 0:
            positions = values[:, :3]
            turned = Rotation.from_euler("xyz", values[:, 3:], degrees=degrees)
            local[:, index] = turned.as_matrix()
            continue
        zero[index] = ends[bone.parent]
        ends[index] = zero[index] + bone.length * bone.direction
        angles = np.zeros((count, 3))
        for column, turn in enumerate(bone.turns):
            angles[:, _TURNS.index(turn)] = values[:, column]
        turned = Rotation.from_euler("xyz", angles, degrees=degrees)
        local[:, index] = bone.axis @ turned.as_matrix() @ bone.axis.T
    parents = [bone.parent for bone in bones]
    metres = _METRES / unit
    return SkeletonMotion(
        joint_names=tuple(bone.name for bone in bones),
        parents=np.array(parents),
        zero_joints=zero * metres,
        world_rotations=world_rotations(local, parents),
        root_positions=positions * metres,
        times_us=np.round(np.arange(count) * 1e6 / FRAME_RATE_HZ).astype(np.int64),
        world_from_source=_WORLD,
        source=str(path),
    )


def _read_skeleton(path: Path) -> tuple[list[_Bone], float, bool]:
    """Bones with parents before children, the root first; the unit of length; True for degrees."""
    section, unit, degrees = "", 1.0, True
    given: dict[str, _Bone] = {}
    current = _Bone("", -1)
    above: dict[str, str] = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            if words[0].startswith(":"):
                section = words[0]
            elif section == ":units" and words[0] == "length":
                unit = float(words[1])
            elif section == ":units" and words[0] == "angle":
                degrees = not words[1].lower().startswith("rad")
            elif section == ":root" and words[0] == "order":
                _refuse_order(" ".join(words[1:]).lower(), " ".join(_ROOT))
            elif section == ":root" and words[0] == "axis":
                _refuse_order(words[1].lower(), "xyz")
            elif section == ":bonedata":
                if words[0] == "begin":
                    current = _Bone("", 0)
                elif words[0] == "end":
                    given[current.name] = current
                else:
                    _read_bone_line(current, words, degrees)
            elif section == ":hierarchy" and words[0] not in ("begin", "end"):
                above |= {child: words[0] for child in words[1:]}
        except (ValueError, IndexError) as error:
            raise DataError(f"{path}: line {number} cannot be read ({error}).") from None
    bones = [_Bone("root", -1)]
    slots = {"root": 0}
    for name, parent in above.items():
        if name not in given or parent not in slots:
            raise DataError(
                f"{path}: bone {name} below {parent}: expected both in :bonedata, parents first."
            )
        slots[name] = len(bones)
        given[name].parent = slots[parent]
        bones.append(given[name])
    if len(bones) == 1 or unit <= 0:
        raise DataError(f"{path}: holds no bones or no unit of length, expected an .asf skeleton.")
    return bones, unit, degrees


def _refuse_order(found: str, expected: str) -> None:
    if found != expected:
        raise ValueError(f"the order {found[:40]}, expected {expected}; export it in that order")


def _read_bone_line(bone: _Bone, words: list[str], degrees: bool) -> None:
    if words[0] == "name":
        bone.name = words[1]
    elif words[0] == "direction":
        bone.direction = np.array(_three(words))
    elif words[0] == "length":
        bone.length = float(words[1])
    elif words[0] == "axis":
        _refuse_order(" ".join(words[4:5]).lower() or "xyz", "xyz")
        bone.axis = Rotation.from_euler("xyz", _three(words), degrees=degrees).as_matrix()
    elif words[0] == "dof":
        bone.turns = tuple(word.lower() for word in words[1:] if word.lower() in _TURNS)


def _three(words: list[str]) -> list[float]:
    numbers = [float(word) for word in words[1:4]]
    if len(numbers) < 3:
        raise ValueError(f"{len(numbers)} numbers after {words[0]}, expected 3")
    return numbers


def _read_frames(path: Path, degrees: bool) -> tuple[list[dict[str, list[str]]], bool]:
    """Numbers of each bone in each frame; ``degrees`` unless the file says otherwise."""
    frames: list[dict[str, list[str]]] = []
    for line in read_text(path).splitlines():
        words = line.split()
        if len(words) == 1 and words[0].isdecimal():
            frames.append({})
        elif frames and words:
            frames[-1][words[0]] = words[1:]
        elif words and words[0].lower() in (":degrees", ":radians"):
            degrees = words[0].lower() == ":degrees"
    if not frames:
        raise DataError(f"{path}: holds no frame, expected an .amc motion.")
    return frames, degrees


def _values(path: Path, frames: list[dict[str, list[str]]], bone: _Bone, count: int) -> np.ndarray:
    if count == 0:
        return np.zeros((len(frames), 0))
    rows = [frame.get(bone.name, []) for frame in frames]
    wrong = [index for index, row in enumerate(rows) if len(row) != count]
    if wrong:
        raise DataError(
            f"{path}: frame {wrong[0] + 1} has {len(rows[wrong[0]])} numbers for {bone.name}, "
            f"expected {count}; does the .asf belong to it?"
        )
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{path}: {bone.name} cannot be read ({error}).") from None
    if not np.isfinite(values).all():
        raise DataError(f"{path}: {bone.name} has numbers that are not finite.")
    return values
