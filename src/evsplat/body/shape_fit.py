"""The free body's shape for a person of whom only the skeleton is known."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from evsplat.body.make import default_body
from evsplat.body.skeleton import Skeleton, find_skeleton

_COEFFICIENTS = 10
# A coefficient of 1 is as likely as a length that is off by this much.
_LENGTH_PRIOR_M = 0.01


def shape_like(
    joint_names: tuple[str, ...],
    parents: Sequence[int],
    joints: Float[np.ndarray, "J 3"],
    *,
    source: str = "skeleton",
) -> Float[np.ndarray, "10"]:
    """Shape coefficients of `default_body` that make it as tall and long-limbed as the skeleton.

    ``joints`` (metres) are at rest. Rigs put the hip at different heights of the same person, so
    lengths are compared that do not depend on it. How stout the person is, joints cannot tell.
    """
    wanted = _lengths(find_skeleton(parents, joint_names, source), np.asarray(joints, np.float64))
    body = default_body()
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    mean = body.rest_joints.double().numpy()
    # joints are linear in the coefficients
    directions = np.stack(
        [default_body(one).rest_joints.double().numpy() - mean for one in np.eye(_COEFFICIENTS)]
    )

    def misfit(betas: np.ndarray) -> np.ndarray:
        lengths = _lengths(skeleton, mean + np.tensordot(betas, directions, 1))
        return np.concatenate([(lengths - wanted) / _LENGTH_PRIOR_M, betas])

    return least_squares(misfit, np.zeros(_COEFFICIENTS)).x


def _lengths(skeleton: Skeleton, joints: np.ndarray) -> np.ndarray:
    """Arms, shins, from the shoulders to the ankles, between the shoulders; means of both sides."""
    place = {name: joints[joint] for name, joint in skeleton.limbs.items()}
    across = float(np.linalg.norm(place["left_upper_arm"] - place["right_upper_arm"]))
    total = np.zeros(4)
    for side in ("left", "right"):
        arm, elbow, hand, hip, knee, ankle = (
            place[f"{side}_{part}"]
            for part in ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
        )
        bones = [elbow - arm, hand - elbow, ankle - knee, knee - hip, hip - arm]
        upper, fore, shin, thigh, trunk = np.linalg.norm(bones, axis=1)
        total += upper, fore, shin, trunk + thigh + shin
    return np.append(total / 2, across)
