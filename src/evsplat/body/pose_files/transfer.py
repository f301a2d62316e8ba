"""Poses of the SMPL family on a body of another skeleton: for people without a licensed model."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body.body import Body
from evsplat.body.make import default_betas_for_stature, default_body
from evsplat.body.pose_files.sequence import PoseSequence
from evsplat.body.retarget import SkeletonMotion, retarget
from evsplat.body.smpl_skeleton import NAMES, PARENTS, rest_joints
from evsplat.body.tree import world_rotations


def skeleton_motion(
    sequence: PoseSequence,
    *,
    world_from_sequence: Float[np.ndarray, "3 3"] | None = None,
    body_models: Path | str | None = None,
    zero_joints: Float[np.ndarray, "22 3"] | None = None,
) -> SkeletonMotion:
    """The motion of the 22 joints without hands and face; times follow from ``sequence.fps``.

    ``world_from_sequence`` rotates the sequence's world, for example from y up to z up. Where no
    frame rate is known, times count frames as seconds. ``zero_joints`` are the subject's joints at
    rest where they are known from elsewhere than the model.
    """
    zero = zero_joints
    if zero is None:
        zero = rest_joints(
            sequence.model,
            sequence.betas,
            sequence.gender,
            body_models=body_models,
            source=sequence.source,
        )
    vectors = sequence.poses[:, : len(NAMES)]
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    return SkeletonMotion(
        joint_names=NAMES,
        parents=np.array(PARENTS),
        zero_joints=zero,
        world_rotations=world_rotations(local, PARENTS),
        root_positions=zero[0] + sequence.transl,
        times_us=sequence.times_us(sequence.fps or 1.0),
        world_from_source=np.eye(3) if world_from_sequence is None else world_from_sequence,
        source=sequence.source,
    )


def to_default_body(
    sequence: PoseSequence,
    *,
    stature_m: float | None = None,
    root_scale: float | None = None,
    world_from_sequence: Float[np.ndarray, "3 3"] | None = None,
    floor_up: tuple[float, float, float] | None = None,
    body_models: Path | str | None = None,
) -> tuple[Body, Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """The shipped body doing what the person did: body, poses (axis-angle, local), translation.

    The person's shape (betas) is not transferred; ``stature_m`` makes the body that tall.
    ``root_scale`` is how far the body moves per metre of the person: by default the ratio of leg
    lengths where the world is the camera (which leaves the picture unchanged), and 1 where the
    world holds cameras that would otherwise no longer fit.
    """
    betas = None if stature_m is None else default_betas_for_stature(stature_m)
    body = default_body(betas)
    holds_cameras = sequence.world == "calibration" or sequence.world_to_camera is not None
    if root_scale is None and holds_cameras:
        root_scale = 1.0
    motion = skeleton_motion(
        sequence, world_from_sequence=world_from_sequence, body_models=body_models
    )
    poses, transl = retarget(motion, body, root_scale=root_scale, floor_up=floor_up)
    return body, poses, transl
