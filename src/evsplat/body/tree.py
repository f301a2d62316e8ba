"""Kinematic trees given by the index of each joint's parent: order, levels, world rotations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.errors import DataError


@dataclass(frozen=True)
class Level:
    """Joints of equal depth; the root is alone in level 0."""

    joints: Int[Tensor, "L"]
    parents: Int[Tensor, "L"]
    """Index of the parent joint."""
    parent_slots: Int[Tensor, "L"]
    """Position of the parent within the level above (0 for the root)."""


def joint_depths(parents: Sequence[int], source: str = "kinematic tree") -> list[int]:
    """Depth of every joint, 0 for the root; any order of joints.

    Raises:
        DataError: not exactly one root (-1), a parent out of range, or a cycle.
    """
    count = len(parents)
    roots = [joint for joint, parent in enumerate(parents) if parent == -1]
    if len(roots) != 1:
        raise DataError(
            f"{source}: parents has {len(roots)} roots (entries of -1), expected exactly one. "
            "Join the skeletons under one root joint."
        )
    depths = [-1] * count
    depths[roots[0]] = 0
    for joint in range(count):
        chain = []
        while depths[joint] < 0:
            if not 0 <= parents[joint] < count:
                raise DataError(
                    f"{source}: parents[{joint}] is {parents[joint]}, "
                    f"expected -1 or 0..{count - 1}."
                )
            chain.append(joint)
            if len(chain) > count:
                raise DataError(f"{source}: parents of joint {chain[0]} form a cycle, not a tree.")
            joint = int(parents[joint])
        for above, member in enumerate(reversed(chain), start=1):
            depths[member] = depths[joint] + above
    return depths


def topological_order(parents: Sequence[int], source: str = "kinematic tree") -> list[int]:
    """Joints in an order where parents precede their children; unchanged where they already do."""
    depths = joint_depths(parents, source)
    if all(parent < joint for joint, parent in enumerate(parents)):
        return list(range(len(parents)))
    return np.argsort(depths, kind="stable").tolist()


def tree_levels(parents: Sequence[int]) -> tuple[Level, ...]:
    """Levels of a tree from the root down, for loops over depth instead of over joints."""
    depths = joint_depths(parents)
    levels: list[Level] = []
    slots: dict[int, int] = {-1: 0}
    for depth in range(max(depths) + 1):
        members = [joint for joint, d in enumerate(depths) if d == depth]
        above = [int(parents[joint]) for joint in members]
        levels.append(
            Level(
                torch.tensor(members),
                torch.tensor(above),
                torch.tensor([slots[parent] for parent in above]),
            )
        )
        slots = {joint: slot for slot, joint in enumerate(members)}
    return tuple(levels)


def level_inverse(levels: Sequence[Level]) -> Int[Tensor, "J"]:
    """Position of each joint in the concatenation of all levels."""
    return torch.argsort(torch.cat([level.joints for level in levels]))


def world_rotations(
    local: Float[np.ndarray, "T J 3 3"], parents: Sequence[int]
) -> Float[np.ndarray, "T J 3 3"]:
    """World rotations of rotations relative to the parent; parents come before their children."""
    world = np.array(local, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    return world
