"""How wrong a motion's spline is between its key poses, told from the keys alone."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from evsplat.body.rotations import matrix_to_quaternion
from evsplat.body.track import BodyTrack

FEWEST_KEYS = 5
"""With fewer key poses nothing is told."""
_FINER = 4.0
"""By how much the error falls when keys come twice as often: a cubic spline's falls 16-fold where
motion is smooth, by less where it is fast; captures with true poses show 3 to 11."""


@dataclass(frozen=True)
class BetweenKeys:
    """Root mean square errors per axis."""

    rotation_rad: Float[np.ndarray, " J"]
    """Per joint."""
    translation_m: float
    """Of the root's place."""


def between_keys(track: BodyTrack) -> BetweenKeys:
    """From what the spline through every other key misses at the keys that it leaves out."""
    keys = len(track.times_us)
    joints = track.poses.shape[1]
    if keys < FEWEST_KEYS:
        return BetweenKeys(np.zeros(joints, np.float32), 0.0)
    sparse = BodyTrack(track.body, track.times_us[::2], track.poses[::2], track.transl[::2])
    left_out = track.times_us[1 : keys - (keys % 2 == 0) : 2]
    times = torch.from_numpy(left_out)
    (turned, moved), (true_turn, true_move) = sparse.at(times), track.at(times)
    apart = matrix_to_quaternion(turned.transpose(-1, -2) @ true_turn)
    angles = 2 * torch.asin(apart[..., 1:].norm(dim=-1).clamp(max=1)).double().numpy()
    rotation = np.sqrt(np.square(angles).mean(0) / 3) / _FINER
    translation = float((moved - true_move).double().square().mean().sqrt()) / _FINER
    return BetweenKeys(rotation.astype(np.float32), translation)
