"""How far the spline through key poses is from the motion between them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body.rotations import matrix_to_quaternion
from evsplat.body.track import BodyTrack

_MOST_KEYS = 4_096
FEWEST_SPLINE_KEYS = 5
"""Fewer key poses give no estimate of the spline's error."""
_ERROR_RATIO = 4.0
"""Spline error with every other key over that with all keys. A cubic spline's falls 16-fold where
motion is smooth, by less where it is fast; captures with true poses show 3 to 11."""
_CARRIED = 0.7561
"""Variance halfway between two keys of a cubic spline through values of variance 1 that are new at
every key: its squared weights there, summed, of many keys evenly apart."""


@dataclass(frozen=True)
class SplineError:
    """Root mean square errors, per axis, of a track's spline between its keys."""

    rotation_rad: Float[np.ndarray, " J"]
    """Error of each joint's rotation."""
    translation_m: float
    """Error of the root's place."""


def spline_error(track: BodyTrack) -> SplineError:
    """Error of the spline between its keys, from the spline through every other one of them.

    What the sparser spline misses at the keys that it leaves out, divided by `_ERROR_RATIO`. Of a
    long recording the keys in its middle tell. Errors of the keys are in it, see
    `apart_from_errors`.
    """
    first = max(0, len(track.times_us) - _MOST_KEYS) // 2
    times_us, poses, transl = (
        values[first : first + _MOST_KEYS] for values in (track.times_us, track.poses, track.transl)
    )
    keys, joints = poses.shape[:2]
    if keys < FEWEST_SPLINE_KEYS:
        return SplineError(np.zeros(joints, np.float32), 0.0)
    sparse = BodyTrack(track.body, times_us[::2], poses[::2], transl[::2])
    left_out = times_us[1 : keys - (keys % 2 == 0) : 2]
    times = torch.from_numpy(left_out)
    (turned, moved), (true_turn, true_move) = sparse.at(times), track.at(times)
    apart = matrix_to_quaternion(turned.transpose(-1, -2) @ true_turn)
    angles = 2 * torch.asin(apart[..., 1:].norm(dim=-1).clamp(max=1)).double().numpy()
    rotation = np.sqrt(np.square(angles).mean(0) / 3) / _ERROR_RATIO
    translation = float((moved - true_move).double().square().mean().sqrt()) / _ERROR_RATIO
    return SplineError(rotation.astype(np.float32), translation)


def apart_from_errors(missed: Float[Tensor, "*N"], new: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Of a `spline_error` what can be told from errors that are new at every key.

    ``new``: their standard deviation per axis, in the same unit. They are in what was missed at the
    keys left out, and are taken off its square. What remains is how the person moves; nothing
    remains where errors explain it all. Halfway between two keys it adds to what the spline carries
    there of the errors, which are learned as well: of the sum the share of its variance is the
    motion's, and by that share it is less.
    """
    known = (1 + _CARRIED) * new.square() / _ERROR_RATIO**2
    own = (missed.square() - known).clamp_min(0)
    carried = _CARRIED * new.square()
    return own.sqrt() * own / (own + carried).clamp_min(torch.finfo(own.dtype).tiny)
