"""SMPL poses of a data set as the body of a capture: SMPL itself, or the body that ships."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import smpl_skeleton
from evsplat.body.body import Body
from evsplat.body.make import default_body, shape_like
from evsplat.body.pose_files import PoseSequence
from evsplat.body.pose_files.transfer import skeleton_motion
from evsplat.body.retarget import SkeletonMotion, retarget
from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.body.skeleton import find_skeleton
from evsplat.body.smpl import ENVIRONMENT, find_model_file, read_model_file, smpl_body
from evsplat.body.tree import world_rotations
from evsplat.capture.derive import Derivation
from evsplat.capture.write import CaptureWriter
from evsplat.errors import DataError, WeightsError

_COEFFICIENTS = 10
_COMPARED = ("shin", "foot", "upper_arm", "forearm", "hand")
_JOINT_SAMPLES = 32
_JOINTS = len(smpl_skeleton.NAMES)


def add_body(
    writer: CaptureWriter | Derivation,
    times_us: Sequence[int],
    sequence: PoseSequence,
    smpl: Path | None,
    *,
    rest_joints: Float[np.ndarray, "J 3"] | None = None,
    turn: Float[np.ndarray, "3 3"] | None = None,
) -> list[str]:
    """Give the capture its body, one key pose per time; returns notes for the user.

    With the user's SMPL file the body is the sequence's model; without it the motion is carried
    over to the body that ships with evsplat, at the size of ``rest_joints`` (the first joints of
    the subject at rest in the model's axes) where the data set tells them. ``turn`` leads from the
    axes of the sequence's world to the capture's.
    """
    file = model_file(smpl, sequence.model, sequence.gender)
    if file is not None:
        betas = sequence.betas
        if not len(betas) and rest_joints is not None:
            betas = _betas_of(file, rest_joints)
        if turn is not None:
            model, gender = sequence.model, sequence.gender
            body = smpl_body(model, betas, gender=gender, path=file, source=sequence.source)
            sequence = sequence.turned(turn, body.rest_joints[0].double().numpy())
        writer.set_body(
            sequence.model,
            times_us,
            sequence.poses,
            sequence.transl,
            betas=betas,
            gender=sequence.gender,
            source=sequence.pose_source,
        )
        return [
            f"body: {sequence.model.upper()} ({sequence.gender}); the capture does not hold the "
            f"model file, {ENVIRONMENT} has to lead to it"
        ]
    known = rest_joints is not None
    average = smpl_skeleton.approximate_rest_joints(sequence.model)
    joints = np.asarray(rest_joints)[:_JOINTS] if known else average
    motion = skeleton_motion(sequence, zero_joints=joints, world_from_sequence=turn)
    shape = shape_like(smpl_skeleton.NAMES, smpl_skeleton.PARENTS, joints)
    body = default_body(shape)
    poses, transl = retarget(motion, body, root_scale=1.0)
    transl = transl + _limb_offset(motion, body, poses, transl)
    writer.set_body("default", times_us, poses, transl, betas=shape, source=sequence.pose_source)
    size = "at the subject's own size" if known else "at an average size, the data does not tell it"
    folder = os.environ.get(ENVIRONMENT)
    searched = f"({sequence.gender}) in {folder}" if folder else "(--smpl)"
    return [
        f"body: no {sequence.model.upper()} file {searched}, so the free body moves instead, "
        f"{size}; limbs may be off by some pixels"
    ]


def model_file(smpl: Path | None, model: str, gender: str) -> Path | None:
    """The user's model file; without a path, that of the environment variable, if there is one."""
    if smpl is not None:
        return find_model_file(model, gender, smpl)
    try:
        return find_model_file(model, gender) if os.environ.get(ENVIRONMENT) else None
    except WeightsError:
        return None


def chosen_poses(sequence: PoseSequence, frames: Sequence[int]) -> PoseSequence:
    """The poses of those frames, in ascending order; every one must be there."""
    place = {int(frame): index for index, frame in enumerate(sequence.frames)}
    absent = [frame for frame in frames if frame not in place]
    if absent:
        raise DataError(
            f"{sequence.source}: has no pose of frame {absent[0]} ({len(absent)} of {len(frames)} "
            "are missing), expected one for every picture; leave such frames out with --frames."
        )
    rows = [place[frame] for frame in frames]
    cameras = sequence.world_to_camera
    return replace(
        sequence,
        frames=sequence.frames[rows],
        poses=sequence.poses[rows],
        transl=sequence.transl[rows],
        world_to_camera=None if cameras is None else cameras[rows],
    )


def some_of(paths: list[Path]) -> list[Path]:
    """Up to twice `_JOINT_SAMPLES` of the files, evenly spread, for `unposed`."""
    return paths[:: max(1, len(paths) // _JOINT_SAMPLES)]


def unposed(
    samples: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> Float[np.ndarray, "24 3"]:
    """Rest joints of a subject whose posed joints a data set tells.

    ``samples`` are poses (24, 3) in axis-angle, posed joints (24, 3) with or without the
    translation, and the translation (3,). A bone is at rest what it is in the axes of the joint
    above it; medians over the samples.
    """
    poses, places, shifts = (np.stack(part) for part in zip(*samples, strict=True))
    parents = list(smpl_skeleton.SMPL_PARENTS)
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    turns = world_rotations(local, parents)[:, parents[1:]]
    bones = np.einsum("tjrc,tjr->tjc", turns, places[:, 1:] - places[:, parents[1:]])
    # only one of the two readings puts the pelvis where SMPL's template has it
    roots = [np.median(places[:, 0], axis=0), np.median(places[:, 0] - shifts, axis=0)]
    usual = smpl_skeleton.approximate_rest_joints("smpl")[0]
    rest = np.zeros((len(parents), 3))
    rest[0] = min(roots, key=lambda root: float(np.linalg.norm(root - usual)))
    for joint, parent in enumerate(parents[1:], start=1):
        rest[joint] = rest[parent] + np.median(bones[:, joint - 1], axis=0)
    return rest


def _betas_of(file: Path, rest: np.ndarray) -> np.ndarray:
    """Shape coefficients whose bones are nearest to those of ``rest``."""
    model = read_model_file(file)
    for key in ("J_regressor", "v_template", "shapedirs"):
        if key not in model:
            raise DataError(f"{file}: {key}: not found, expected a body model.")
    regressor = model["J_regressor"][: len(rest)]
    mean = regressor @ model["v_template"]
    directions = np.einsum("jv,vdb->bjd", regressor, model["shapedirs"][..., :_COEFFICIENTS])
    bones = (directions[:, 1:] - directions[:, :1]).reshape(len(directions), -1).T
    target = ((rest - rest[0]) - (mean - mean[0]))[1:].ravel()
    # a little of the prior that coefficients are around 1: the joints leave some undetermined
    system = np.vstack([bones, 1e-4 * np.eye(len(directions))])
    padded = np.concatenate([target, np.zeros(len(directions))])
    return np.linalg.lstsq(system, padded, rcond=None)[0]


def _limb_offset(
    motion: SkeletonMotion, body: Body, poses: np.ndarray, transl: np.ndarray
) -> Float[np.ndarray, "T 3"]:
    """Mean offset of the source's limbs from the body's, over knees, elbows and so on.

    Rigs disagree about where in a person the hip is, but not about these joints.
    """
    rotations = axis_angle_to_matrix(torch.from_numpy(np.asarray(poses)))
    placed = body.joint_transforms(rotations, torch.from_numpy(np.asarray(transl)))
    mover = find_skeleton(motion.parents.tolist(), motion.joint_names)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    limbs = [name for name in mover.limbs if name.endswith(_COMPARED)]
    sources = motion.joints()[:, [mover.limbs[name] for name in limbs]]
    targets = placed[:, [taker.limbs[name] for name in limbs], :3, 3].numpy()
    return (sources - targets).mean(axis=1)
