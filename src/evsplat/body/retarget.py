"""Motion of one skeleton carried over to the joints of another body."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from evsplat.body.body import Body, skin
from evsplat.body.rotations import nearest_axis_angle
from evsplat.body.skeleton import Skeleton, find_skeleton
from evsplat.body.tree import topological_order
from evsplat.errors import DataError

COLLAR_SHARE = 0.12
"""Share of the upper arm's turn that a collar bone takes where the source has no collar bones."""
_ALIGNED = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}
"""Parts that take the source's bone direction, and where their bone ends."""
_ABOVE = {"forearm": "upper_arm", "shin": "thigh"}
_LEG = ("thigh", "shin", "foot")
_FLOOR_FRAMES = 60


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """Motion of a skeleton: turns of its joints since the zero pose, and places of its root.

    T times, J joints. A joint without a rotation of its own (the end of a limb) repeats its
    parent's. The zero pose is any upright pose whose joints are known; it faces along an axis.
    """

    joint_names: tuple[str, ...]
    parents: Int[np.ndarray, "J"]
    """Index of the parent; -1 for the root."""
    zero_joints: Float[np.ndarray, "J 3"]
    """Joints in the zero pose, metres, axes of the source; the origin does not matter."""
    world_rotations: Float[np.ndarray, "T J 3 3"]
    """Rotation of each joint from the zero pose to each time, axes of the source."""
    root_positions: Float[np.ndarray, "T 3"]
    """The root joint, metres, axes of the source."""
    times_us: Int[np.ndarray, "T"]
    world_from_source: Float[np.ndarray, "3 3"]
    """Rotation from the axes of the source to those of the world."""
    source: str = "motion"
    """Name in messages."""

    def joints(self) -> Float[np.ndarray, "T J 3"]:
        """Joints in the world at each time, by forward kinematics."""
        placed = np.zeros((len(self.times_us), len(self.parents), 3))
        for joint in topological_order(self.parents.tolist(), self.source):
            parent = self.parents[joint]
            if parent < 0:
                placed[:, joint] = self.root_positions
            else:
                bone = self.zero_joints[joint] - self.zero_joints[parent]
                placed[:, joint] = placed[:, parent] + self.world_rotations[:, parent] @ bone
        return placed @ self.world_from_source.T


def retarget(
    source: SkeletonMotion,
    target: Body,
    *,
    joint_map: Mapping[str, str] | None = None,
    root_scale: float | None = None,
    floor_up: tuple[float, float, float] | None = None,
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Poses (axis-angle, local) and translation with which ``target`` does what the source did.

    Each joint of the target turns by ``R(t) = W D(t) F^-1 A``: D is the turn of the source's joint
    since its zero pose, W takes the source's axes to the world, F the source's upright zero pose to
    the target's rest pose, and A takes the target's rest bones of arms and legs to the source's
    zero-pose bones by the smallest rotation, upper ones first; so they point where the source's
    did, and elbows and knees do not twist. Spine and neck of unequal length share the bend evenly;
    a collar bone that the source lacks follows the arm a little. What else the target has (fingers)
    stays in rest with its parent. Skeletons of equal names and tree are matched one to one.

    The midpoint of the hips goes where the source's was, times ``root_scale`` (default: leg length
    of the target over that of the source, which leaves the picture unchanged where the camera is
    the origin). ``floor_up`` lifts the motion along that unit vector until the lowest vertex is
    at 0 in all but the lowest tenth of the frames.

    ``joint_map`` names the source's joint for joints of the target that should not be guessed.
    Axis-angle vectors follow each other without jumps of a whole turn.

    Raises:
        DataError: arrays that do not fit each other, or a skeleton whose limbs are not recognised.
    """
    _check(source)
    mover = find_skeleton(source.parents.tolist(), source.joint_names, source.source)
    taker = find_skeleton(target.parents.tolist(), target.joint_names, "target body")
    rest = target.rest_joints.detach().cpu().double().numpy()
    zero = np.asarray(source.zero_joints, np.float64)
    upright = rest_from_zero(mover, zero, taker, rest)
    turns = _matched_turns(source, mover, target, taker, joint_map or {})
    into_world = np.asarray(source.world_from_source, np.float64)
    aligned = alignments(mover, zero @ upright.T, taker, rest)
    parents = target.parents.tolist()
    world = np.empty((len(source.times_us), len(parents), 3, 3))
    for joint, parent in enumerate(parents):
        turn = turns[joint]
        if turn is None:
            world[:, joint] = world[:, parent]
        else:
            world[:, joint] = into_world @ turn @ upright.T @ aligned[joint]
    scale = leg_length(taker, rest) / leg_length(mover, zero) if root_scale is None else root_scale
    hips = _hips(mover, zero) - zero[mover.root]
    centre = source.root_positions + source.world_rotations[:, mover.root] @ hips
    root = scale * centre @ into_world.T - world[:, 0] @ (_hips(taker, rest) - rest[0])
    local = world.copy()
    local[:, 1:] = world[:, parents[1:]].swapaxes(-1, -2) @ world[:, 1:]
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()
    poses = nearest_axis_angle(vectors.reshape(*local.shape[:2], 3))
    transl = root - rest[0]
    if floor_up is not None:
        transl = transl + _lift(target, local, transl, np.asarray(floor_up, np.float64))
    return poses, transl


def leg_length(skeleton: Skeleton, joints: Float[np.ndarray, "J 3"]) -> float:
    """Thigh plus shin, mean of both sides."""
    total = 0.0
    for side in ("left", "right"):
        hip, knee, ankle = (joints[skeleton.limbs[f"{side}_{part}"]] for part in _LEG)
        total += float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    return total / 2


def rest_from_zero(
    mover: Skeleton,
    zero: Float[np.ndarray, "J 3"],
    taker: Skeleton,
    rest: Float[np.ndarray, "K 3"],
) -> Float[np.ndarray, "3 3"]:
    """Rotation from the source's zero pose to the target's rest pose, both upright.

    Trunks differ by a few degrees of lean that are anatomy and not direction, and skeletons are
    drawn along their axes: the nearest rotation that takes axes to axes is meant.
    """
    rotation = trunk_axes(taker, rest) @ trunk_axes(mover, zero).T
    snapped = np.zeros((3, 3))
    for _ in range(3):
        size = np.abs(snapped)
        taken = size.sum(0) + size.sum(1)[:, None]
        free = np.where(taken > 0, 0, np.abs(rotation))
        row, column = np.unravel_index(free.argmax(), (3, 3))
        snapped[row, column] = np.sign(rotation[row, column])
    angle = np.degrees(Rotation.from_matrix(snapped.T @ rotation).magnitude())
    return snapped if np.linalg.det(snapped) > 0 and angle < 25 else rotation


def trunk_axes(skeleton: Skeleton, joints: np.ndarray) -> np.ndarray:
    """Columns: towards the left, up along the trunk, forward."""
    limbs = skeleton.limbs
    left = joints[limbs["left_thigh"]] - joints[limbs["right_thigh"]]
    shoulders = (joints[limbs["left_upper_arm"]] + joints[limbs["right_upper_arm"]]) / 2
    left = left / np.linalg.norm(left)
    up = shoulders - _hips(skeleton, joints)
    up = up - left * (left @ up)
    up = up / np.linalg.norm(up)
    return np.stack((left, up, np.cross(left, up)), -1)


def _hips(skeleton: Skeleton, joints: np.ndarray) -> np.ndarray:
    return (joints[skeleton.limbs["left_thigh"]] + joints[skeleton.limbs["right_thigh"]]) / 2


def _matched_turns(
    source: SkeletonMotion,
    mover: Skeleton,
    target: Body,
    taker: Skeleton,
    joint_map: Mapping[str, str],
) -> list[np.ndarray | None]:
    """The source's turn (T, 3, 3) for every joint of the target; None: it follows its parent."""
    turns = np.asarray(source.world_rotations, np.float64)
    found: list[np.ndarray | None] = [None] * len(target.parents)
    same = source.joint_names == target.joint_names
    if same and np.array_equal(source.parents, target.parents.cpu().numpy()):
        found = list(turns.swapaxes(0, 1))
    else:
        found[taker.root] = turns[:, mover.root]
        for name, joint in taker.limbs.items():
            if name in mover.limbs:
                found[joint] = turns[:, mover.limbs[name]]
            elif name.endswith("collar"):
                arm = mover.limbs[name.replace("collar", "upper_arm")]
                found[joint] = _collar(turns[:, mover.chest], turns[:, arm])
        for below, above, chain in (
            (mover.root, mover.spine, taker.spine),
            (mover.chest, mover.neck, taker.neck),
        ):
            spread = _spread(turns[:, [below, *above]], len(chain))
            found = [
                spread[chain.index(joint)] if joint in chain else turn
                for joint, turn in enumerate(found)
            ]
    for name, origin in joint_map.items():
        for known, names in ((name, target.joint_names), (origin, source.joint_names)):
            if known not in names:
                raise DataError(
                    f"{source.source}: joint_map names '{known}', which is none of "
                    f"{', '.join(names)}."
                )
        found[target.joint_names.index(name)] = turns[:, source.joint_names.index(origin)]
    return found


def _spread(knots: np.ndarray, count: int) -> list[np.ndarray]:
    """``count`` rotations at even steps along a chain of them (T, K, 3, 3), the last its end."""
    last = knots.shape[1] - 1
    spread = []
    for place in np.linspace(0, last, count + 1)[1:]:
        index = min(int(place + 1e-9), last)
        share = place - index
        start = knots[:, index]
        if share < 1e-9:
            spread.append(start)
            continue
        bend = Rotation.from_matrix(start.swapaxes(-1, -2) @ knots[:, index + 1]).as_rotvec()
        spread.append(start @ Rotation.from_rotvec(share * bend).as_matrix())
    return spread


def _collar(chest: np.ndarray, arm: np.ndarray) -> np.ndarray:
    raised = Rotation.from_matrix(chest.swapaxes(-1, -2) @ arm).as_rotvec()
    angle = np.linalg.norm(raised, axis=-1, keepdims=True)
    # At half a turn the axis flips: the share has died away by then, so that nothing jumps.
    fade = np.minimum(1.0, 2 * (np.pi - angle) / np.maximum(angle, 1e-9))
    return chest @ Rotation.from_rotvec(COLLAR_SHARE * fade * raised).as_matrix()


def alignments(mover: Skeleton, zero: np.ndarray, taker: Skeleton, rest: np.ndarray) -> np.ndarray:
    """A of every joint of the target; ``zero`` already stands in the target's axes."""
    aligned = np.tile(np.eye(3), (len(rest), 1, 1))
    for side in ("left", "right"):
        for part, end in _ALIGNED.items():
            start, stop = (taker.limbs[f"{side}_{name}"] for name in (part, end))
            first, last = (mover.limbs[f"{side}_{name}"] for name in (part, end))
            # From where the bone above has taken it: the elbow bends and does not twist.
            above = aligned[taker.limbs[f"{side}_{_ABOVE[part]}"]] if part in _ABOVE else np.eye(3)
            bone = above @ (rest[stop] - rest[start])
            aligned[start] = smallest_rotation(bone, zero[last] - zero[first]) @ above
        aligned[taker.limbs[f"{side}_hand"]] = aligned[taker.limbs[f"{side}_forearm"]]
    return aligned


def smallest_rotation(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The rotation by the smallest angle that turns one direction into another."""
    if min(np.linalg.norm(start), np.linalg.norm(end)) < 1e-6:
        raise DataError("A bone of an arm or leg has no length; give the joints of the zero pose.")
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(a, b), a @ b
    if cosine < -1 + 1e-12:  # half a turn about any axis across
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return Rotation.from_rotvec(np.pi * across / np.linalg.norm(across)).as_matrix()
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def _lift(target: Body, local: np.ndarray, transl: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Shift along ``up`` that puts the feet on the floor, from evenly chosen frames."""
    lowest = []
    height = torch.from_numpy(up).float().to(target.rest_vertices.device)
    for frame in np.unique(np.linspace(0, len(local) - 1, _FLOOR_FRAMES).astype(int)):
        bones = target.bone_transforms(
            torch.from_numpy(local[frame]).to(height), torch.from_numpy(transl[frame]).to(height)
        )
        moved, _ = skin(target.rest_vertices, target.weights, bones[None])
        lowest.append(float((moved[0] @ height).min()))
    return -np.percentile(lowest, 10) * up


def _check(source: SkeletonMotion) -> None:
    joints, times = len(source.joint_names), len(source.times_us)
    if times == 0:
        raise DataError(f"{source.source}: holds no pose.")
    for name, shape in (
        ("parents", (joints,)),
        ("zero_joints", (joints, 3)),
        ("world_rotations", (times, joints, 3, 3)),
        ("root_positions", (times, 3)),
        ("times_us", (times,)),
        ("world_from_source", (3, 3)),
    ):
        value = np.asarray(getattr(source, name))
        if value.shape != shape:
            raise DataError(f"{source.source}: {name} has shape {value.shape}, expected {shape}.")
        if not np.isfinite(value).all():
            raise DataError(f"{source.source}: {name} holds values that are not finite.")
    for name in ("world_rotations", "world_from_source"):
        turn = np.asarray(getattr(source, name))
        off = np.abs(turn @ turn.swapaxes(-1, -2) - np.eye(3)).max()
        if off > 1e-3 or (np.linalg.det(turn) < 0).any():
            raise DataError(
                f"{source.source}: {name} holds matrices that are no rotations (off by {off:.2g})."
            )
