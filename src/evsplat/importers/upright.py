"""A world that stands upright: structure from motion leaves its axes anyhow."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_BODY = 0.01
"""Weight of the body's direction, beside cameras that are held level: it leans, but it tells where
up is if all cameras look one way."""


def upright(
    world_to_camera: Float[np.ndarray, "F 4 4"], body_up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The turn of a world that makes what is up in it one of its axes, the nearest.

    Pictures' rows are level where nobody holds the camera askew, so that up is across all of them;
    ``body_up``, the mean direction of a person's trunk, tells which way, and up itself where the
    rows are all alike.
    """
    rows = world_to_camera[:, 0, :3]
    body = body_up / np.linalg.norm(body_up)
    spread = rows.T @ rows / len(rows) + _BODY * (np.eye(3) - np.outer(body, body))
    up = np.linalg.eigh(spread)[1][:, 0]
    up = up if up @ body > 0 else -up
    axis = np.zeros(3)
    nearest = int(np.abs(up).argmax())
    axis[nearest] = np.sign(up[nearest])
    # of a single pair of directions it is the shortest way
    turn: np.ndarray = Rotation.align_vectors(axis[None], up[None])[0].as_matrix()
    return turn
