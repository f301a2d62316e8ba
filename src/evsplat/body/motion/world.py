"""What motion readers share: composing rotations down a tree, and the way up."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from evsplat.body.make import default_body
from evsplat.body.retarget import rest_from_zero
from evsplat.body.skeleton import find_skeleton


def down_the_tree(
    local: Float[np.ndarray, "T J 3 3"], parents: Sequence[int]
) -> Float[np.ndarray, "T J 3 3"]:
    """World rotations of rotations relative to the parent; parents come before their children."""
    world = np.array(local, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    return world


def upright_world(
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
