"""Biovision hierarchies (``.bvh``), what most motion tools export."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body.make import default_body
from evsplat.body.motion.limits import check_extent
from evsplat.body.retarget import SkeletonMotion, rest_from_zero
from evsplat.body.skeleton import find_skeleton
from evsplat.body.tree import world_rotations
from evsplat.errors import DataError
from evsplat.untrusted.text import read_text

_LARGEST = 1e6
"""Of an offset, in whatever unit."""
_CHANNELS = [f"{axis}{kind}" for kind in ("position", "rotation") for axis in "xyz"]


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: list[str] = field(default_factory=list)
    """Out of `_CHANNELS`."""


def read_bvh(path: Path) -> SkeletonMotion:
    """The motion of a ``.bvh``.

    The pose of all offsets is the zero pose: it must stand upright, which tells the axes. The unit
    of length does not matter, because retargeting scales by the length of the legs.
    """
    words = iter(read_text(path).split())
    try:
        joints, frame_time, values = _read(words)
    except StopIteration:
        raise DataError(f"{path}: ends too early; copy it again.") from None
    except (ValueError, IndexError, OverflowError) as error:
        raise DataError(f"{path}: not a readable BVH file ({error}).") from None
    if not joints or values.size == 0 or not np.isfinite(values).all() or frame_time <= 0:
        raise DataError(f"{path}: holds no joints, no frames or no frame time above zero.")
    check_extent(path, len(values), len(joints))
    parents = [joint.parent for joint in joints]
    local = np.tile(np.eye(3), (len(values), len(joints), 1, 1))
    zero = np.zeros((len(joints), 3))
    positions = np.tile(np.array(joints[0].offset), (len(values), 1))
    column = 0
    for index, joint in enumerate(joints):
        zero[index] = joint.offset
        if joint.parent >= 0:
            zero[index] += zero[joint.parent]
        for channel in joint.channels:
            axis = channel[0]
            if channel.endswith("rotation"):
                turn = Rotation.from_euler(
                    axis, values[:, column : column + 1], degrees=True
                ).as_matrix()
                local[:, index] = local[:, index] @ turn
            elif joint.parent < 0:
                positions[:, "xyz".index(axis)] = values[:, column]
            column += 1
    names = tuple(joint.name for joint in joints)
    return SkeletonMotion(
        joint_names=names,
        parents=np.array(parents),
        zero_joints=zero,
        world_rotations=world_rotations(local, parents),
        root_positions=positions,
        times_us=np.round(np.arange(len(values)) * frame_time * 1e6).astype(np.int64),
        world_from_source=_upright_world(parents, names, zero, str(path)),
        source=str(path),
    )


def _read(words: Iterator[str]) -> tuple[list[_Joint], float, np.ndarray]:
    joints: list[_Joint] = []
    stack: list[int] = []
    ends = 0
    for word in words:
        if word in ("ROOT", "JOINT"):
            if word == "ROOT" and joints:
                raise ValueError("several roots; save one person per file")
            joints.append(_Joint(next(words), stack[-1] if stack else -1))
            stack.append(len(joints) - 1)
        elif word == "End":
            ends += 1
        elif word == "OFFSET":
            offset = tuple([_length(next(words)) for _ in range(3)])
            # an end site only says how long the last bone is
            if not ends:
                joints[-1].offset = offset
        elif word == "CHANNELS":
            joints[-1].channels = [_channel(next(words)) for _ in range(int(next(words)))]
        elif word == "}":
            if ends:
                ends -= 1
            else:
                stack.pop()
        elif word == "MOTION":
            break
    header = [next(words) for _ in range(5)]
    if header[0] != "Frames:" or header[2:4] != ["Frame", "Time:"]:
        raise ValueError("MOTION must begin with Frames: and Frame Time:")
    count, channels = int(header[1]), sum(len(joint.channels) for joint in joints)
    values = np.array(list(words), dtype=np.float64)
    if values.size != count * channels:
        raise ValueError(f"{values.size} numbers, expected {count} frames of {channels}")
    return joints, float(header[4]), values.reshape(count, channels)


def _length(word: str) -> float:
    length = float(word)
    if not abs(length) <= _LARGEST:
        raise ValueError(f"an offset of {word[:40]}")
    return length


def _channel(word: str) -> str:
    if word.lower() not in _CHANNELS:
        raise ValueError(f"a channel {word!r}, expected Xposition to Zrotation")
    return word.lower()


def _upright_world(
    parents: Sequence[int],
    joint_names: Sequence[str],
    zero_joints: Float[np.ndarray, "J 3"],
    source: str,
) -> Float[np.ndarray, "3 3"]:
    """Rotation to z up, facing -y, of the axes in which the zero pose stands."""
    body = default_body()
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    mover = find_skeleton(parents, joint_names, source)
    return rest_from_zero(mover, zero_joints, taker, body.rest_joints.double().numpy())
