"""Errors of estimated body poses, of a size that is measured and not guessed."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import Body, axis_angle_to_matrix
from evsplat.body.continuity import nearest_axis_angle
from evsplat.body.skeleton import find_skeleton
from evsplat.staging.motion import height_m

PoseNoise = Literal["none", "mocap", "estimated", "estimated-blurry"]

LEVELS: dict[str, float] = {
    "none": 0.0,
    "mocap": 0.003,
    "estimated": 0.01,
    "estimated-blurry": 0.02,
}
"""Mean error of wrists and ankles as a share of the body's height. A pose network run on frames of
a synthetic 512-pixel kick missed them by 1 to 2 % of the height, blurry frames being twice as bad;
0.3 % (5 mm) is what markers reach."""
_MEMORY_S = 0.08
"""Errors of neighbouring frames are alike: their correlation falls to 1/e in this time."""
_SHIFT_M_PER_RAD = 0.3
"""Root displacement that goes with a radian of joint error."""
_ROUNDS = 12


def add_pose_noise(
    body: Body,
    times_us: np.ndarray,
    poses: Float[np.ndarray, "P J 3"],
    transl: Float[np.ndarray, "P 3"],
    level: float,
    seed: int,
) -> tuple[Float[np.ndarray, "P J 3"], Float[np.ndarray, "P 3"], float]:
    """Poses whose wrists and ankles are off by ``level`` times the height, in the mean.

    Every joint turns by Gaussian noise that is correlated in time, and the root shifts; the noise
    is scaled until the mean is met. Also gives that mean error in metres.
    """
    if level == 0:
        return poses, transl, 0.0
    rng = np.random.default_rng([seed, 0x90])
    unit = _correlated(rng, times_us, (poses.shape[1] + 1, 3))
    exact = Rotation.from_rotvec(poses.reshape(-1, 3))

    def noisy(size: float) -> tuple[np.ndarray, np.ndarray]:
        turns = Rotation.from_rotvec(size * unit[:, :-1].reshape(-1, 3))
        turned = (exact * turns).as_rotvec().reshape(poses.shape)
        return nearest_axis_angle(turned), transl + size * _SHIFT_M_PER_RAD * unit[:, -1]

    truth, goal = _extremities(body, poses, transl), level * height_m(body)
    size = level
    for _ in range(_ROUNDS):
        moved = _extremities(body, *noisy(size))
        error = float(np.linalg.norm(moved - truth, axis=-1).mean())
        size *= goal / error
    return *noisy(size), error


def _correlated(rng: np.random.Generator, times_us: np.ndarray, shape: tuple) -> np.ndarray:
    """Unit Gaussian noise (P, *shape), a first-order process in time."""
    white = rng.normal(size=(len(times_us), *shape))
    keep = np.exp(-np.diff(times_us) * 1e-6 / _MEMORY_S)
    for index, share in enumerate(keep, start=1):
        white[index] = share * white[index - 1] + np.sqrt(1 - share**2) * white[index]
    return white


def _extremities(body: Body, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Wrists and ankles in the world, (P, 4, 3)."""
    limbs = find_skeleton(body.parents.tolist(), body.joint_names).limbs
    joints = [limbs[f"{side}_{part}"] for side in ("left", "right") for part in ("hand", "foot")]
    rotations = axis_angle_to_matrix(torch.from_numpy(poses))
    frames = body.joint_transforms(rotations, torch.from_numpy(transl))
    return frames[:, joints, :3, 3].numpy()
