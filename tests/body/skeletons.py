"""Skeletons of several tools, in poses and axes of their own, and random motions of them."""

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.body.retarget import SkeletonMotion
from evsplat.body.tree import topological_order

# x left, y up, z forward; a T-pose.
SMPL = {
    "pelvis": (None, (0.0, 0.0, 0.0)),
    "left_hip": ("pelvis", (0.07, -0.09, 0.0)),
    "right_hip": ("pelvis", (-0.07, -0.09, 0.0)),
    "spine1": ("pelvis", (0.0, 0.11, -0.02)),
    "left_knee": ("left_hip", (0.03, -0.38, 0.0)),
    "right_knee": ("right_hip", (-0.03, -0.38, 0.0)),
    "spine2": ("spine1", (0.0, 0.14, 0.02)),
    "left_ankle": ("left_knee", (-0.01, -0.41, -0.04)),
    "right_ankle": ("right_knee", (0.01, -0.41, -0.04)),
    "spine3": ("spine2", (0.0, 0.06, 0.0)),
    "left_foot": ("left_ankle", (0.04, -0.06, 0.12)),
    "right_foot": ("right_ankle", (-0.04, -0.06, 0.12)),
    "neck": ("spine3", (0.0, 0.21, -0.03)),
    "left_collar": ("spine3", (0.07, 0.11, -0.02)),
    "right_collar": ("spine3", (-0.07, 0.11, -0.02)),
    "head": ("neck", (0.0, 0.09, 0.05)),
    "left_shoulder": ("left_collar", (0.12, 0.04, -0.01)),
    "right_shoulder": ("right_collar", (-0.12, 0.04, -0.01)),
    "left_elbow": ("left_shoulder", (0.26, -0.01, -0.02)),
    "right_elbow": ("right_shoulder", (-0.26, -0.01, -0.02)),
    "left_wrist": ("left_elbow", (0.25, 0.01, 0.0)),
    "right_wrist": ("right_elbow", (-0.25, 0.01, 0.0)),
    "left_hand": ("left_wrist", (0.08, -0.01, -0.01)),
    "right_hand": ("right_wrist", (-0.08, -0.01, -0.01)),
}
# x forward, y up, z right; arms hang, one joint for the trunk, no collar bones.
DEEPMIMIC = {
    "root": (None, (0.0, 0.0, 0.0)),
    "chest": ("root", (0.0, 0.24, 0.0)),
    "neck": ("chest", (0.0, 0.22, 0.0)),
    "right_hip": ("root", (0.0, 0.0, 0.08)),
    "right_knee": ("right_hip", (0.0, -0.42, 0.0)),
    "right_ankle": ("right_knee", (0.0, -0.41, 0.0)),
    "right_shoulder": ("chest", (-0.02, 0.24, 0.18)),
    "right_elbow": ("right_shoulder", (0.0, -0.27, 0.0)),
    "right_wrist": ("right_elbow", (0.0, -0.26, 0.0)),
    "left_hip": ("root", (0.0, 0.0, -0.08)),
    "left_knee": ("left_hip", (0.0, -0.42, 0.0)),
    "left_ankle": ("left_knee", (0.0, -0.41, 0.0)),
    "left_shoulder": ("chest", (-0.02, 0.24, -0.18)),
    "left_elbow": ("left_shoulder", (0.0, -0.27, 0.0)),
    "left_wrist": ("left_elbow", (0.0, -0.26, 0.0)),
}
# Acclaim bones as in the CMU recordings; x left, y up, z forward; legs and arms slant.
ACCLAIM = {
    "root": (None, (0.0, 0.0, 0.0)),
    "lhipjoint": ("root", (0.0, 0.0, 0.0)),
    "lfemur": ("lhipjoint", (0.11, -0.1, 0.05)),
    "ltibia": ("lfemur", (0.14, -0.39, 0.0)),
    "lfoot": ("ltibia", (0.15, -0.4, 0.0)),
    "ltoes": ("lfoot", (0.01, -0.04, 0.13)),
    "rhipjoint": ("root", (0.0, 0.0, 0.0)),
    "rfemur": ("rhipjoint", (-0.11, -0.1, 0.05)),
    "rtibia": ("rfemur", (-0.14, -0.39, 0.0)),
    "rfoot": ("rtibia", (-0.15, -0.4, 0.0)),
    "rtoes": ("rfoot", (-0.01, -0.04, 0.13)),
    "lowerback": ("root", (0.0, 0.0, 0.0)),
    "upperback": ("lowerback", (0.0, 0.12, 0.0)),
    "thorax": ("upperback", (0.0, 0.12, 0.0)),
    "lowerneck": ("thorax", (0.0, 0.12, 0.0)),
    "upperneck": ("lowerneck", (0.0, 0.1, 0.02)),
    "head": ("upperneck", (0.0, 0.09, 0.0)),
    "lclavicle": ("thorax", (0.0, 0.12, 0.0)),
    "lhumerus": ("lclavicle", (0.17, 0.04, 0.0)),
    "lradius": ("lhumerus", (0.27, 0.0, 0.0)),
    "lwrist": ("lradius", (0.17, 0.0, 0.0)),
    "lhand": ("lwrist", (0.085, 0.0, 0.0)),
    "rclavicle": ("thorax", (0.0, 0.12, 0.0)),
    "rhumerus": ("rclavicle", (-0.17, 0.04, 0.0)),
    "rradius": ("rhumerus", (-0.27, 0.0, 0.0)),
    "rwrist": ("rradius", (-0.17, 0.0, 0.0)),
    "rhand": ("rwrist", (-0.085, 0.0, 0.0)),
}
RIGID = ("lhipjoint", "rhipjoint", "lwrist", "rwrist")
"""Acclaim's bones that do not bend."""
Y_UP_FACING_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
Y_UP_FACING_X = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""To axes with z up and the person facing -y."""


def tables(skeleton):
    """Names, parents and zero-pose joints of one of the tables above."""
    names = tuple(skeleton)
    parents = np.array([-1 if up is None else names.index(up) for up, _ in skeleton.values()])
    joints = np.zeros((len(names), 3))
    for joint in topological_order(parents.tolist()):
        offset = np.array(skeleton[names[joint]][1])
        joints[joint] = offset + (joints[parents[joint]] if parents[joint] >= 0 else 0)
    return names, parents, joints


def world_turns(parents, local):
    """Rotations since the zero pose of every joint, from local ones (T, J, 3, 3)."""
    world = np.array(local)
    for joint in topological_order(list(parents)):
        if parents[joint] >= 0:
            world[:, joint] = world[:, parents[joint]] @ local[:, joint]
    return world


def random_motion(names, parents, joints, seed, *, times=5, axes=None, bend=0.8):
    """A motion with any orientation of the root and joints bent by about ``bend`` radians."""
    rng = np.random.default_rng(seed)
    vectors = bend * rng.normal(size=(times, len(names), 3))
    vectors[:, 0] = rng.normal(size=(times, 3)) * 2
    vectors[:, [joint for joint, name in enumerate(names) if name in RIGID]] = 0
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(times, -1, 3, 3)
    motion = SkeletonMotion(
        tuple(names),
        np.asarray(parents),
        np.asarray(joints, np.float64),
        world_turns(parents, local),
        rng.normal(size=(times, 3)),
        np.arange(times) * 40_000,
        np.eye(3) if axes is None else axes,
    )
    return motion, vectors


def one_joint_turning(skeleton, name, vectors, axes):
    """The zero pose but for one joint, turned by each of ``vectors`` (T, 3); root at rest."""
    names, parents, joints = tables(skeleton)
    local = np.tile(np.eye(3), (len(vectors), len(names), 1, 1))
    local[:, names.index(name)] = Rotation.from_rotvec(vectors).as_matrix()
    times = np.arange(len(vectors)) * 40_000
    turns = world_turns(parents, local)
    return SkeletonMotion(names, parents, joints, turns, np.zeros((len(times), 3)), times, axes)
