"""Errors of a pose estimator, made up: for synthetic captures and for tests of robustness."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from evsplat.body.body import Body
from evsplat.body.pose_errors import PoseErrors, PoseSource
from evsplat.body.rotations import axis_angle_to_matrix, nearest_axis_angle
from evsplat.body.skeleton import find_skeleton
from evsplat.errors import ConfigError

_WAVES = 64
_ROUNDS = 6
_TRUNK = 0.5
"""Share of a limb joint's angle that spine and neck get, each as a whole."""


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the errors; they wander smoothly, with a part new in every pose."""

    joint_rad: float
    """Rotation of each limb joint, per axis."""
    root_rad: float
    """Orientation of the whole body, per axis."""
    root_m: float
    """Place of the root across the view, per axis."""
    depth_m: float
    """Place of the root along the view."""
    correlation_s: float = 0.2
    """Time over which the smooth part changes: its autocorrelation is exp(-(dt / this)^2 / 2)."""
    jitter: float = 0.2
    """Share of the variance that is independent from pose to pose, 0..1."""


NOISE_PRESETS = {
    "one_percent": PoseNoise(0.0116, 0.006, 0.0035, 0.012),
    "two_percent": PoseNoise(0.0232, 0.012, 0.007, 0.024),
    "sharp_video": PoseNoise(0.066, 0.029, 0.0145, 0.044),
    "blurry_video": PoseNoise(0.129, 0.057, 0.029, 0.086),
}
"""Named by what wrists and ankles are off by on average, with the shipped body.

``one_percent`` and ``two_percent``: of the body height, in space (17 and 34 mm). ``sharp_video``
and ``blurry_video``: what MediaPipe 0.10.21 was off by across the view on sharp and on blurry
frames of a spin kick (10.0 and 19.5 of 512 pixels at 3.35 m with a focal length of 600: 56 and
109 mm). How that divides into joints, root and depth, and how fast it changes, is our choice.
"""


def noisy_poses(
    body: Body,
    poses: Float[np.ndarray, "T J 3"],
    transl: Float[np.ndarray, "T 3"],
    times_us: Int[np.ndarray, "T"],
    noise: PoseNoise | str,
    *,
    seed: int,
    view: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Poses and translation as an estimator with this ``noise`` (or preset) would have them.

    Limbs, spine, neck and root err, fingers do not. ``view`` is the unit vector of the camera's
    axis in the world. The smooth part is one function of time per seed: the same at the same time
    whatever the other times are, so that sparse and dense poses of a capture agree.

    Raises:
        ConfigError: an unknown preset.
    """
    if isinstance(noise, str):
        if noise not in NOISE_PRESETS:
            raise ConfigError(f"No pose noise '{noise}'; there are {', '.join(NOISE_PRESETS)}.")
        noise = NOISE_PRESETS[noise]
    angles = joint_angles(body, noise)
    seconds = np.asarray(times_us, np.float64) * 1e-6
    rng = np.random.default_rng(seed)
    wander = _wander(rng, seconds, 3 * (len(angles) + 1), noise.correlation_s)
    fresh = rng.normal(size=wander.shape)
    error = np.sqrt(1 - noise.jitter) * wander + np.sqrt(noise.jitter) * fresh
    error = error.reshape(len(seconds), -1, 3)
    turned = (
        Rotation.from_rotvec(np.asarray(poses, np.float64).reshape(-1, 3))
        * Rotation.from_rotvec((error[:, :-1] * angles[:, None]).reshape(-1, 3))
    ).as_rotvec()
    axis = np.asarray(view, np.float64) / np.linalg.norm(view)
    along = error[:, -1] @ axis
    shift = noise.root_m * (error[:, -1] - along[:, None] * axis)
    shift += noise.depth_m * along[:, None] * axis
    return nearest_axis_angle(turned.reshape(np.shape(poses))), transl + shift


def poses_off_by(
    body: Body,
    poses: Float[np.ndarray, "T J 3"],
    transl: Float[np.ndarray, "T 3"],
    times_us: Int[np.ndarray, "T"],
    mean_m: float,
    *,
    seed: int,
    view: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"], float, PoseNoise]:
    """Noisy poses whose wrists and ankles are off by ``mean_m`` in the mean.

    As `noisy_poses`, with the presets' proportions; gives the mean that was reached and the noise
    as well.
    """
    if mean_m == 0:
        return poses, transl, 0.0, PoseNoise(0.0, 0.0, 0.0, 0.0)
    one, size = NOISE_PRESETS["one_percent"], 1.0
    truth = _extremities(body, poses, transl)
    for _ in range(_ROUNDS):
        noise = replace(
            one,
            joint_rad=size * one.joint_rad,
            root_rad=size * one.root_rad,
            root_m=size * one.root_m,
            depth_m=size * one.depth_m,
        )
        found = noisy_poses(body, poses, transl, times_us, noise, seed=seed, view=view)
        error = float(np.linalg.norm(_extremities(body, *found) - truth, axis=-1).mean())
        size *= mean_m / error
    return *found, error, noise


def noise_errors(
    body: Body,
    noise: PoseNoise,
    poses: int,
    source: PoseSource,
    *,
    view: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> PoseErrors:
    """Errors of that many `noisy_poses` as a capture states them: what they were drawn with."""
    along = np.square(np.asarray(view, np.float64) / np.linalg.norm(view))
    root_m = np.sqrt(noise.root_m**2 * (1 - along) + noise.depth_m**2 * along)
    joint_rad = np.tile(joint_angles(body, noise), (poses, 1))
    return PoseErrors(source, joint_rad, np.tile(root_m, (poses, 1)))


def joint_angles(body: Body, noise: PoseNoise) -> Float[np.ndarray, "J"]:
    """Standard deviation of each joint's rotation, radians per axis."""
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names, "body")
    angles = np.zeros(len(body.parents))
    for name, joint in skeleton.limbs.items():
        angles[joint] = 0.0 if name.endswith("collar") else noise.joint_rad
    for chain in (skeleton.spine, skeleton.neck):
        # Errors of a chain add up as the root of their number.
        angles[list(chain)] = _TRUNK * noise.joint_rad / np.sqrt(max(1, len(chain)))
    angles[skeleton.root] = noise.root_rad
    return angles


def _wander(
    rng: np.random.Generator, seconds: np.ndarray, count: int, correlation_s: float
) -> np.ndarray:
    """``count`` smooth random functions of unit variance at the given times.

    Sums of cosines with random frequencies and phases, which are Gaussian processes with the
    Gaussian kernel in the limit of many (Rahimi and Recht, Random features, NIPS 2007).
    """
    speed = rng.normal(size=(_WAVES, count)) / max(correlation_s, 1e-6)
    phase = rng.uniform(0, 2 * np.pi, size=(_WAVES, count))
    waves = np.zeros((len(seconds), count))
    for one_speed, one_phase in zip(speed, phase, strict=True):
        waves += np.cos(seconds[:, None] * one_speed + one_phase)
    return np.sqrt(2 / _WAVES) * waves


def _extremities(body: Body, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Wrists and ankles in the world, (T, 4, 3)."""
    limbs = find_skeleton(body.parents.tolist(), body.joint_names, "body").limbs
    joints = [limbs[f"{side}_{part}"] for side in ("left", "right") for part in ("hand", "foot")]
    rotations = axis_angle_to_matrix(torch.from_numpy(poses))
    frames = body.joint_transforms(rotations, torch.from_numpy(transl))
    return frames[:, joints, :3, 3].numpy()
