"""What a motion file may announce, and what must hold of the motion that it gives."""

from pathlib import Path

import numpy as np

from evsplat.body.retarget import SkeletonMotion
from evsplat.errors import DataError

_LARGEST = 1e9
_MOST_TURNS = 20_000_000
"""Frames times joints: an hour at 120 Hz of 46 joints, 1.4 GB of matrices."""


def check_extent(path: Path, frames: int, joints: int) -> None:
    """A `DataError` before memory is taken for more turns than any recording has."""
    if frames * joints > _MOST_TURNS:
        raise DataError(
            f"{path}: {frames:,} frames of {joints:,} joints, expected at most {_MOST_TURNS:,} "
            "turns in all; cut it into pieces."
        )


def checked_motion(motion: SkeletonMotion) -> SkeletonMotion:
    """The motion; a `DataError` where its numbers are not finite or its times do not ascend."""
    parts = (motion.zero_joints, motion.world_rotations, motion.root_positions)
    if not all((np.abs(part) < _LARGEST).all() for part in parts):
        raise DataError(f"{motion.source}: holds numbers that are not finite, or above 1e9.")
    if (np.diff(motion.times_us) <= 0).any() or motion.times_us.min() < 0:
        raise DataError(
            f"{motion.source}: its frames are too short or too long for times in microseconds; "
            "correct the frame time."
        )
    return motion
