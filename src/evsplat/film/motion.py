"""Motions of the person: any motion or pose file, or one that ships, on a recording's body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, SkeletonMotion, retarget, up_axis
from evsplat.body.motion import load_motion
from evsplat.body.pose_files import read_poses, skeleton_motion
from evsplat.body.retarget import smallest_rotation
from evsplat.body.rotations import nearest_axis_angle
from evsplat.body.skeleton import find_skeleton
from evsplat.errors import ConfigError, DataError
from evsplat.staging.assets import find_motion, motions

_MOTION_SUFFIXES = (".bvh", ".amc", ".txt")
_FLOOR_TIMES = 40
_FLOOR_PERCENTILE = 10
"""Share of the time in which feet may sink in: a jump's landing must not lift all the rest."""
_Z = np.array([0.0, 0.0, 1.0])
"""Up in the world of motion files."""
_UP = {"camera": (0.0, -1.0, 0.0), "y up": (0.0, 1.0, 0.0), "z up": (0.0, 0.0, 1.0)}
"""Up in the worlds of pose files; a camera is taken to stand level."""


def load_motion_of(
    name: str, recorded: BodyTrack, *, fps: float | None = None, in_place: bool = False
) -> BodyTrack:
    """The motion ``name`` on the body of ``recorded``, placed where that was; starts at time 0.

    ``name``: one of `evsplat.staging.assets.motions`, a motion file (.bvh, .amc, DeepMimic .txt) or
    a pose file or folder of any tool that `read_poses` knows. ``fps``: poses per second where the
    file does not say. ``in_place`` leaves out all travel along the floor.

    Raises:
        ConfigError: ``fps`` is missing, or the motion has times of its own.
        DataError: no such motion, a file that cannot be read, a skeleton that is not recognised.
    """
    ships = name in motions()
    path = Path(find_motion(name) if ships else name)
    if not path.exists():
        raise DataError(
            f"--motion {name}: neither a file nor one of {', '.join(motions())}; correct the name."
        )
    if ships or path.suffix.lower() in _MOTION_SUFFIXES:
        if fps is not None:
            raise ConfigError(
                f"--motion-fps {fps:g}: motion {name} has times of its own, expected a pose file; "
                "leave it out."
            )
        return place_motion(load_motion(path), recorded, up=_Z, in_place=in_place)
    sequence = read_poses(path)
    if fps is None and sequence.fps is None:
        raise ConfigError(
            f"--motion {name}: the file does not say how many poses there are in a second; "
            "give --motion-fps."
        )
    motion = skeleton_motion(replace(sequence, fps=sequence.fps if fps is None else fps))
    up = np.array(_UP[sequence.world]) if sequence.world in _UP else None
    return place_motion(motion, recorded, up=up, in_place=in_place)


def place_motion(
    motion: SkeletonMotion,
    recorded: BodyTrack,
    *,
    up: Float[np.ndarray, "3"] | None,
    in_place: bool = False,
) -> BodyTrack:
    """``motion`` on the body of ``recorded``: same floor, same spot, same first direction.

    ``up`` is the motion's up in the world of ``world_from_source``; None finds the axis nearest to
    the body's own. The middle of the path comes to the middle of the recorded one, the person
    starts off facing where the recorded one does at the start, and stands as high. Times begin at
    0.
    """
    body = recorded.body.to("cpu")
    recorded = recorded.to("cpu")
    poses, transl = retarget(motion, body)
    track = BodyTrack(body, motion.times_us, poses, transl, source=motion.source)
    if up is None:
        up = up_axis(track).double().numpy()
    floor_up = up_axis(recorded).double().numpy()
    turn = smallest_rotation(up, floor_up)
    turn = _heading(turn @ _facing(track), _facing(recorded), floor_up) @ turn
    rest = body.rest_joints[0].double().numpy()
    root = (transl + rest) @ turn.T
    there = recorded.at(recorded.times_us.tolist())[1].double().numpy() + rest
    if in_place:
        root = (root @ floor_up)[:, None] * floor_up
    root += (there.max(0) + there.min(0) - root.max(0) - root.min(0)) / 2
    turned = poses.copy()
    turned[:, 0] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    turned = nearest_axis_angle(turned)
    times = motion.times_us - motion.times_us[0]
    track = BodyTrack(body, times, turned, root - rest, source=motion.source)
    lift = _floor(recorded, floor_up) - _floor(track, floor_up)
    return BodyTrack(body, times, turned, root - rest + lift * floor_up, source=motion.source)


def _facing(track: BodyTrack) -> Float[np.ndarray, "3"]:
    """Vector from the right hip to the left one at the start, in the world."""
    body = track.body
    limbs = find_skeleton(body.parents.tolist(), body.joint_names, "the run's body").limbs
    frames = body.joint_transforms(*track.at([int(track.times_us[0])]))
    joints = frames[0, :, :3, 3].double().numpy()
    return joints[limbs["left_thigh"]] - joints[limbs["right_thigh"]]


def _heading(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The rotation about ``up`` that turns the one direction towards the other."""
    flat = [vector - up * (up @ vector) for vector in (start, end)]
    if min(np.linalg.norm(vector) for vector in flat) < 1e-6:
        return np.eye(3)
    angle = np.arctan2(np.cross(flat[0], flat[1]) @ up, flat[0] @ flat[1])
    return Rotation.from_rotvec(angle * up).as_matrix()


def _floor(track: BodyTrack, up: Float[np.ndarray, "3"]) -> float:
    """Height along ``up`` of the soles."""
    times = np.linspace(track.times_us[0], track.times_us[-1], _FLOOR_TIMES).round().astype(int)
    height = torch.from_numpy(up).float()
    lowest = [float((vertices @ height).min()) for vertices in track.vertices_at(times.tolist())]
    return float(np.percentile(lowest, _FLOOR_PERCENTILE))
