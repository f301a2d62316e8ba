"""Bodies from arrays: a rig, checked and its joints in order, and the shipped parametric body."""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from evsplat.body.body import Body
from evsplat.body.skeleton import Skeleton, find_skeleton
from evsplat.body.tree import topological_order
from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_plain_npz

_BETAS = 10
# A coefficient of 1 is as likely as a length that is off by this much.
_LENGTH_PRIOR_M = 0.01


def make_body(
    rest_vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    weights: Float[np.ndarray, "V J"],
    parents: Int[np.ndarray, "J"],
    rest_joints: Float[np.ndarray, "J 3"],
    joint_names: tuple[str, ...],
    *,
    source: str = "body",
) -> tuple[Body, list[int]]:
    """A checked `Body` from arrays whose joints may come in any order, and the order it took.

    Places are metres, of the body at rest; the parent of the root is negative. ``weights`` are
    scaled so that each vertex's sum to 1. ``source`` begins what errors say.

    Raises:
        DataError: shapes that do not fit, no single root, cycles, face indices out of range, values
            that are not finite, negative weights, or a vertex without any.
    """
    parents = np.asarray(parents).astype(np.int64)
    shapes = {
        "parents": (parents, (len(parents),)),
        "rest_joints": (rest_joints, (len(parents), 3)),
        "rest_vertices": (rest_vertices, (len(rest_vertices), 3)),
        "faces": (faces, (len(faces), 3)),
        "weights": (weights, (len(rest_vertices), len(parents))),
        "joint_names": (np.asarray(joint_names), (len(parents),)),
    }
    for name, (array, expected) in shapes.items():
        if np.shape(array) != expected:
            raise DataError(f"{source}: {name} has shape {np.shape(array)}, expected {expected}.")
    for name in ("rest_joints", "rest_vertices", "weights"):
        if not np.isfinite(shapes[name][0]).all():
            raise DataError(f"{source}: {name} holds values that are not finite; repair the rig.")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(rest_vertices):
        raise DataError(
            f"{source}: faces must hold at least one triangle and vertex indices in "
            f"0..{len(rest_vertices) - 1}."
        )
    totals = weights.sum(1, keepdims=True, dtype=np.float64)
    if (weights < 0).any() or (totals < 1e-6).any():
        raise DataError(
            f"{source}: weights must not be negative and every vertex needs a joint; "
            f"vertex {int(np.argmax((weights < 0).any(1) | (totals[:, 0] < 1e-6)))} is wrong."
        )
    order = topological_order(parents.tolist(), source)
    slot = np.argsort(order)
    moved_parents = np.where(parents[order] < 0, -1, slot[parents[order]])
    body = Body(
        rest_vertices=torch.from_numpy(np.asarray(rest_vertices, np.float32).copy()),
        faces=torch.from_numpy(np.asarray(faces).astype(np.int64)),
        weights=torch.from_numpy((weights / totals)[:, order].astype(np.float32)),
        parents=torch.from_numpy(moved_parents),
        rest_joints=torch.from_numpy(np.asarray(rest_joints, np.float32)[order]),
        joint_names=tuple(str(joint_names[joint]) for joint in order),
    )
    return body, order


def rig_arrays(body: Body) -> dict[str, np.ndarray]:
    """What `make_body` makes the body of, by the names of its arguments."""
    return {
        "joint_names": np.array(body.joint_names),
        "parents": body.parents.numpy().astype(np.int32),
        "rest_joints": body.rest_joints.numpy(),
        "rest_vertices": body.rest_vertices.numpy(),
        "faces": body.faces.numpy().astype(np.int32),
        "weights": body.weights.numpy(),
    }


def default_body(betas: Float[np.ndarray, "B"] | None = None, *, source: str = "betas") -> Body:
    """The shipped parametric body (CC0) with up to 10 shape coefficients, each about -3..3.

    Metres, z up. ``source`` begins what errors say.

    Raises:
        DataError: more coefficients, or some that are not finite.
    """
    data = _default_arrays()
    shape = fit_betas(betas, len(data["shapedirs"]), source)
    vertices = data["v_template"] + np.einsum("b,bvd->vd", shape, data["shapedirs"])
    joints = data["j_template"] + np.einsum("b,bjd->jd", shape, data["j_shapedirs"])
    weights = np.zeros((len(vertices), len(joints)), np.float32)
    np.put_along_axis(weights, data["weights_idx"].astype(np.int64), data["weights_val"], axis=1)
    names = tuple(str(name) for name in data["joint_names"])
    body, _ = make_body(
        vertices, data["faces"], weights, data["parents"], joints, names, source="default body"
    )
    return body


def default_betas_for_stature(stature_m: float) -> Float[np.ndarray, "B"]:
    """The smallest shape coefficients that make the default body this tall, crown to sole.

    Raises:
        DataError: outside 1.4 to 2.1 m, where adults of the body's kind end.
    """
    if not 1.4 <= stature_m <= 2.1:
        raise DataError(f"stature is {stature_m} m, expected 1.4 to 2.1 m.")
    data = _default_arrays()
    betas = np.zeros(len(data["shapedirs"]))
    for _ in range(10):  # which vertices are highest and lowest may change with the shape
        height = data["v_template"][:, 2] + np.einsum("b,bv->v", betas, data["shapedirs"][..., 2])
        top, bottom = int(height.argmax()), int(height.argmin())
        growth = data["shapedirs"][:, top, 2].astype(np.float64) - data["shapedirs"][:, bottom, 2]
        excess = stature_m - (height[top] - height[bottom])
        betas = betas + excess * growth / (growth @ growth)
    return betas


def shape_like(
    joint_names: tuple[str, ...],
    parents: Sequence[int],
    joints: Float[np.ndarray, "J 3"],
) -> Float[np.ndarray, "10"]:
    """Shape coefficients of `default_body` that make it as tall and long-limbed as the skeleton.

    ``joints`` (metres) are at rest. Rigs put the hip at different heights of the same person, so
    lengths are compared that do not depend on it. How stout the person is, joints cannot tell.
    """
    wanted = _lengths(find_skeleton(parents, joint_names), np.asarray(joints, np.float64))
    body = default_body()
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    mean = body.rest_joints.double().numpy()
    # joints are linear in the coefficients
    directions = np.stack(
        [default_body(one).rest_joints.double().numpy() - mean for one in np.eye(_BETAS)]
    )

    def misfit(betas: np.ndarray) -> np.ndarray:
        lengths = _lengths(skeleton, mean + np.tensordot(betas, directions, 1))
        return np.concatenate([(lengths - wanted) / _LENGTH_PRIOR_M, betas])

    return least_squares(misfit, np.zeros(_BETAS)).x


def fit_betas(
    betas: Float[np.ndarray, "B"] | None, count: int, source: str
) -> Float[np.ndarray, "C"]:
    """Shape coefficients padded with zeros to what the model has; more than that is an error."""
    given = np.zeros(0) if betas is None else np.asarray(betas, np.float64).ravel()
    if len(given) > count:
        raise DataError(
            f"{source}: {len(given)} shape coefficients, but the body has {count}; "
            "give one subject's coefficients for this body model."
        )
    if not np.isfinite(given).all():
        raise DataError(f"{source}: shape coefficients must be finite.")
    return np.pad(given, (0, count - len(given)))


@cache
def _default_arrays() -> dict[str, np.ndarray]:
    resource = files("evsplat") / "data" / "default_body.npz"
    return read_plain_npz(Path(str(resource)))


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
