"""Errors of given key poses, estimated from the poses alone; smoothing."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from evsplat.body.track import BodyTrack

FEWEST_KEYS = 8
"""Fewer key poses give no estimate of their noise."""
_LONGEST_PIECE = 256
"""Key poses whose noise is estimated together: the cost grows with the cube."""
_STIFFNESSES = np.geomspace(1e-6, 1e8, 100)
"""Candidates, in units of the cubed time between keys; the first leaves everything as it is."""
_STILL = 1e-4
"""A joint whose quaternions differ by less than this never moves."""


@dataclass(frozen=True)
class MotionNoise:
    """Errors of key poses that are new in every pose."""

    joint_rad: Float[np.ndarray, " J"]
    """Standard deviation of each joint's rotation, radians per axis."""
    root_m: float
    """Standard deviation of the root's place, metres per axis."""
    stiffness_s3: Float[np.ndarray, " J+1"]
    """Weight, per joint and last for the root's place, of the squared second derivative in time
    against squared errors at the keys; what smooths best."""


def motion_noise(track: BodyTrack, most_rad: Float[np.ndarray, " J"], most_m: float) -> MotionNoise:
    """Estimate the noise of a track's key poses where it is known how it divides between joints.

    ``most_rad``, radians per axis, is in proportion to each joint's noise and the most that it is;
    joints of 0 are exact. The root's place has at most ``most_m``, metres per axis.

    Each joint's quaternions are compared with their smoothing spline, whose stiffness generalised
    cross-validation picks (Craven and Wahba, Smoothing noisy data with spline functions, 1979).
    That misjudges single joints, mostly fast ones; the median over joints, as a share of what each
    has at most, holds for all. Given the noise, the stiffness of each joint is the one of least
    unbiased risk (same paper, eq. 1.8).

    Errors that change slowly look like motion and are not found.
    """
    joints = track.poses.shape[1]
    found, stiffness = np.zeros(joints), np.zeros(joints + 1)
    if len(track.times_us) < FEWEST_KEYS:
        return MotionNoise(found, 0.0, stiffness)
    quaternions, pieces = continuous_quaternions(track.poses), _pieces(_seconds(track))
    # A small rotation changes a unit quaternion by half of it, in three of four directions.
    per_component = math.sqrt(3) / 4
    noisy = np.flatnonzero(moving_joints(track) & (most_rad > 0))
    if noisy.size:
        told = [_cross_validated(pieces, quaternions[:, j]) / most_rad[j] for j in noisy]
        found[noisy] = most_rad[noisy] * min(float(np.median(told)) / per_component, 1.0)
    for joint in noisy:
        size = float(found[joint]) * per_component
        stiffness[joint] = _least_risk(pieces, quaternions[:, joint], size)
    root_m = min(_cross_validated(pieces, track.transl), most_m)
    stiffness[-1] = _least_risk(pieces, track.transl, root_m)
    return MotionNoise(found, root_m, stiffness)


def moving_joints(track: BodyTrack) -> Bool[np.ndarray, " J"]:
    """Joints that move at all."""
    return np.ptp(continuous_quaternions(track.poses), axis=0).max(-1) > _STILL


def smoothed(track: BodyTrack, noise: MotionNoise) -> BodyTrack:
    """The track with key poses on the smoothing splines that ``noise`` names (Reinsch 1967)."""
    seconds = _seconds(track)
    series = [*np.moveaxis(continuous_quaternions(track.poses), 1, 0), track.transl]
    *rotations, transl = (
        smooth_values(seconds, values, stiffness) if stiffness > 0 else values
        for values, stiffness in zip(series, noise.stiffness_s3, strict=True)
    )
    stacked = np.stack(rotations, 1)
    poses = Rotation.from_quat(stacked.reshape(-1, 4)).as_rotvec().reshape(track.poses.shape)
    return track.with_keys(track.times_us, poses, transl, errors=track.errors)


def _seconds(track: BodyTrack) -> Float[np.ndarray, " P"]:
    return (track.times_us - track.times_us[0]) * 1e-6


def continuous_quaternions(poses: Float[np.ndarray, "P J 3"]) -> Float[np.ndarray, "P J 4"]:
    """Unit quaternions (x, y, z, w) of poses, each of the sign that is nearer to the one before."""
    count, joints = poses.shape[:2]
    found = Rotation.from_rotvec(poses.reshape(-1, 3)).as_quat().reshape(count, joints, 4)
    turned = (found[1:] * found[:-1]).sum(-1) < 0
    signs = np.cumprod(np.where(turned, -1, 1), axis=0)
    found[1:] *= signs[..., None]
    return found


def _roughness(seconds: np.ndarray) -> tuple[sparse.csc_array, sparse.csc_array]:
    """Q and R of the natural cubic spline through values y at the keys.

    ``y' Q R^-1 Q' y`` is the integral of its squared second derivative.
    """
    gaps = np.diff(seconds)
    count = len(seconds)
    inverse = 1 / gaps
    bands = [inverse[:-1], -inverse[:-1] - inverse[1:], inverse[1:]]
    q = sparse.diags_array(bands, offsets=[0, -1, -2], shape=(count, count - 2))
    inner = gaps[1:-1] / 6
    r = sparse.diags_array([inner, (gaps[:-1] + gaps[1:]) / 3, inner], offsets=[-1, 0, 1])
    return q.tocsc(), r.tocsc()


def smooth_values(
    seconds: Float[np.ndarray, " P"], values: Float[np.ndarray, "P C"], stiffness: float
) -> Float[np.ndarray, "P C"]:
    """What a natural cubic spline has at its P >= 3 ascending keys that is near ``values`` there.

    It is least in squared differences plus ``stiffness`` (s^3) times the integral of its squared
    second derivative (Reinsch, Smoothing by spline functions, 1967).
    """
    q, r = _roughness(seconds)
    return values - stiffness * (q @ splu((r + stiffness * (q.T @ q)).tocsc()).solve(q.T @ values))


@dataclass(frozen=True)
class _Piece:
    """Neighbouring keys, and the directions in which smoothing them shrinks."""

    keys: slice
    directions: np.ndarray
    shrink: np.ndarray
    """(S, P): what a stiffness leaves of each direction."""
    scale: float
    """Cubed median time between keys."""


def _pieces(seconds: np.ndarray) -> list[_Piece]:
    scale = float(np.median(np.diff(seconds))) ** 3
    number = -(-len(seconds) // _LONGEST_PIECE)
    ends = np.linspace(0, len(seconds), number + 1).astype(int).tolist()
    pieces = []
    for first, last in zip(ends, ends[1:], strict=False):
        q, r = _roughness(seconds[first:last])
        values, directions = np.linalg.eigh(q @ np.linalg.solve(r.toarray(), q.T.toarray()))
        bent = np.maximum(values, 0) * scale
        bent[:2] = 0  # constants and straight lines
        shrink = 1 / (1 + _STIFFNESSES[:, None] * bent)
        pieces.append(_Piece(slice(first, last), directions, shrink, scale))
    return pieces


def _misfit(pieces: list[_Piece], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per stiffness: summed squared residual, and the residual's degrees of freedom."""
    channels = values.shape[1]
    residual, freedom = np.zeros(len(_STIFFNESSES)), np.zeros(len(_STIFFNESSES))
    for piece in pieces:
        energy = ((piece.directions.T @ values[piece.keys]) ** 2).sum(1)
        residual += (1 - piece.shrink) ** 2 @ energy
        freedom += channels * (1 - piece.shrink).sum(1)
    return residual, freedom


def _cross_validated(pieces: list[_Piece], values: np.ndarray) -> float:
    """Standard deviation of the noise of values (P, C), per channel."""
    residual, freedom = _misfit(pieces, values)
    best = int(np.argmin(residual / freedom**2))
    return float(np.sqrt(residual[best] / freedom[best]))


def _least_risk(pieces: list[_Piece], values: np.ndarray, noise: float) -> float:
    """Stiffness (s^3) of least expected squared error; 0 where leaving the values alone is best."""
    residual, freedom = _misfit(pieces, values)
    best = int(np.argmin(residual - 2 * noise**2 * freedom))
    return 0.0 if best == 0 else float(_STIFFNESSES[best] * pieces[0].scale)
