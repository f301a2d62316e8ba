"""Random rigs, their joints, and slow float64 references of kinematics and skinning."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import axis_angle_to_matrix


def random_rig(seed, joints=17, vertices=60, shuffled=False):
    """Arrays of a random tree; ``shuffled`` puts joints in any order."""
    rng = np.random.default_rng(seed)
    parents = np.array([-1] + [rng.integers(0, joint) for joint in range(1, joints)])
    order = rng.permutation(joints) if shuffled else np.arange(joints)
    slot = np.argsort(order)
    weights = rng.random((vertices, joints)) ** 4
    return {
        "parents": np.where(parents[order] < 0, -1, slot[parents[order]]),
        "rest_joints": rng.normal(size=(joints, 3)),
        "rest_vertices": rng.normal(size=(vertices, 3)),
        "faces": rng.integers(0, vertices, (2 * vertices, 3)),
        "weights": weights / weights.sum(1, keepdims=True),
        "joint_names": tuple(f"bone{joint}" for joint in range(joints)),
    }


def reference_bones(parents, rest_joints, poses, transl):
    """Rest-to-world bone transforms of one pose, joint by joint."""
    rest = np.asarray(rest_joints, np.float64)
    local = Rotation.from_rotvec(np.asarray(poses, np.float64)).as_matrix()
    bones, frames = np.zeros((len(parents), 4, 4)), {}

    def frame(joint):
        if joint not in frames:
            parent = parents[joint]
            if parent < 0:
                frames[joint] = local[joint], rest[joint] + np.asarray(transl, np.float64)
            else:
                turn, origin = frame(parent)
                place = origin + turn @ (rest[joint] - rest[parent])
                frames[joint] = turn @ local[joint], place
        return frames[joint]

    for joint in range(len(parents)):
        turn, origin = frame(joint)
        bones[joint, :3, :3] = turn
        bones[joint, :3, 3] = origin - turn @ rest[joint]
        bones[joint, 3, 3] = 1
    return bones


def reference_skin(vertices, weights, bones):
    """Linear blend skinning, vertex by vertex and joint by joint."""
    moved = np.zeros((len(vertices), 3))
    for v, vertex in enumerate(np.asarray(vertices, np.float64)):
        for j in np.flatnonzero(weights[v]):
            moved[v] += weights[v, j] * (bones[j, :3, :3] @ vertex + bones[j, :3, 3])
    return moved


def posed_joints(body, poses, transl):
    """Places of the joints (T, J, 3) in poses (T, J, 3)."""
    rotations = axis_angle_to_matrix(torch.from_numpy(poses))
    return body.joint_transforms(rotations, torch.from_numpy(transl))[..., :3, 3].numpy()
