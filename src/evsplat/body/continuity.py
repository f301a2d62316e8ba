"""Axis-angle vectors that follow each other in time without jumps."""

import numpy as np
from jaxtyping import Float


def nearest_axis_angle(poses: Float[np.ndarray, "T *J 3"]) -> Float[np.ndarray, "T *J 3"]:
    """The same rotations, each as the axis-angle vector nearest to that of the time before.

    A rotation has one vector per whole turn about its axis; which of them a tool wrote may change
    from one frame to the next, so that anything which blends the vectors would spin the joint.
    """
    vectors = np.array(poses, np.float64)
    for time in range(1, len(vectors)):
        before, now = vectors[time - 1], vectors[time]
        angle = np.linalg.norm(now, axis=-1, keepdims=True)
        length = np.linalg.norm(before, axis=-1, keepdims=True)
        # Whole turns need no axis of their own: they keep the one of the time before.
        toward = before / np.maximum(length, 1e-12)
        axis = np.where(angle > 1e-9, now / np.maximum(angle, 1e-12), toward)
        turns = np.round(((before * axis).sum(-1, keepdims=True) - angle) / (2 * np.pi))
        vectors[time] = now + 2 * np.pi * turns * axis
    return vectors
