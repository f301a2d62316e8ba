"""DeepMimic's motion files (Peng et al. 2018; github.com/xbpeng/DeepMimic)."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.body.retarget import SkeletonMotion
from evsplat.body.tree import world_rotations
from evsplat.errors import DataError
from evsplat.untrusted.text import parse_json, read_text

# name, parent, offset from the parent (metres; x forward, y up, z right), numbers per frame:
# 4 = quaternion (w, x, y, z), 1 = angle about z, 0 = none.
_JOINTS = (
    ("root", -1, (0, 0, 0), 4),
    ("chest", 0, (0, 0.236151, 0), 4),
    ("neck", 1, (0, 0.223894, 0), 4),
    ("right_hip", 0, (0, 0, 0.084887), 4),
    ("right_knee", 3, (0, -0.421546, 0), 1),
    ("right_ankle", 4, (0, -0.40987, 0), 4),
    ("right_shoulder", 1, (-0.02405, 0.2435, 0.18311), 4),
    ("right_elbow", 6, (0, -0.274788, 0), 1),
    ("right_wrist", 7, (0, -0.258947, 0), 0),
    ("left_hip", 0, (0, 0, -0.084887), 4),
    ("left_knee", 9, (0, -0.421546, 0), 1),
    ("left_ankle", 10, (0, -0.40987, 0), 4),
    ("left_shoulder", 1, (-0.02405, 0.2435, -0.18311), 4),
    ("left_elbow", 12, (0, -0.274788, 0), 1),
    ("left_wrist", 13, (0, -0.258947, 0), 0),
)
_NUMBERS = 4 + sum(joint[3] for joint in _JOINTS)
_WORLD = np.array([[0, 0, -1.0], [-1, 0, 0], [0, 1, 0]])
"""Rotation from the humanoid's axes to z up, facing -y."""


def read_deepmimic(path: Path) -> SkeletonMotion:
    """``humanoid3d_*.txt``: JSON whose ``Frames`` hold duration, root position and rotations."""
    try:
        document = parse_json(read_text(path))
        frames = np.array(document["Frames"], dtype=np.float64)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise DataError(f"{path}: not a DeepMimic motion ({error}); it needs Frames.") from None
    if frames.ndim != 2 or frames.shape[1] != _NUMBERS or len(frames) == 0:
        raise DataError(
            f"{path}: Frames has shape {frames.shape}, expected (T, {_NUMBERS}): duration, root "
            "position and the rotations of DeepMimic's humanoid."
        )
    if not np.isfinite(frames).all() or (frames[:-1, 0] <= 0).any():
        raise DataError(f"{path}: Frames must be finite, with durations above zero; repair it.")
    parents = [joint[1] for joint in _JOINTS]
    local = np.tile(np.eye(3), (len(frames), len(_JOINTS), 1, 1))
    zero = np.zeros((len(_JOINTS), 3))
    column = 4
    for index, (name, parent, offset, count) in enumerate(_JOINTS):
        zero[index] = offset if parent < 0 else zero[parent] + offset
        values = frames[:, column : column + count]
        if count == 4:
            if (np.linalg.norm(values, axis=1) < 1e-6).any():
                raise DataError(f"{path}: a quaternion of {name} is zero; repair that frame.")
            local[:, index] = Rotation.from_quat(values, scalar_first=True).as_matrix()
        elif count == 1:
            local[:, index] = Rotation.from_euler("z", values).as_matrix()
        column += count
    seconds = np.concatenate(([0.0], np.cumsum(frames[:-1, 0])))
    return SkeletonMotion(
        joint_names=tuple(joint[0] for joint in _JOINTS),
        parents=np.array(parents),
        zero_joints=zero,
        world_rotations=world_rotations(local, parents),
        root_positions=frames[:, 1:4],
        times_us=np.round(seconds * 1e6).astype(np.int64),
        world_from_source=_WORLD,
        source=str(path),
    )
