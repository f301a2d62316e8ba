"""GVHMR: ``hmr4d_results.pt``, SMPL-X in the camera and in a gravity-aligned world."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_CAMERA, _WORLD = "smpl_params_incam", "smpl_params_global"


def fits(content: Any) -> bool:
    """True for GVHMR's ``hmr4d_results.pt``."""
    return has(content, _CAMERA, _WORLD)


def read(documents: list[Document], request: Request) -> PoseSequence:
    """Poses in the camera, or (``world``) in the static world with y up and the camera in it."""
    content, where = documents[0].content, str(documents[0].path)
    poses, transl, betas = _parameters(content, _CAMERA, where)
    count, cameras = len(poses), None
    person = choose_person({"0": count}, request.person, where)
    intrinsics = None
    if "K_fullimg" in content:
        intrinsics = numbers(content, "K_fullimg", (count, 3, 3), where)[0]
    if request.world:
        pelvis = request.pelvis("smplx", betas, where)
        seen = poses, transl
        poses, transl, betas = _parameters(content, _WORLD, where)
        if len(poses) != count:
            raise DataError(
                f"{where}: {_WORLD} has {len(poses)} frames, {_CAMERA} {count}; run GVHMR again."
            )
        cameras = _cameras(*seen, poses, transl, pelvis)
    return make_sequence(
        model="smplx",
        frames=np.arange(count),
        poses=poses,
        transl=transl,
        betas=betas,
        source=where,
        world="y up" if request.world else "camera",
        pose_source="estimated",
        person=person,
        K=intrinsics,
        world_to_camera=cameras,
    )


def _parameters(content: Any, key: str, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    group, where = content[key], f"{where}: {key}"
    body = numbers(group, "body_pose", (None, 63), where)
    count = len(body)
    root = numbers(group, "global_orient", (count, 3), where)
    poses = np.concatenate((root, body), 1).reshape(count, 22, 3)
    betas = numbers(group, "betas", (count, None), where)
    return poses, numbers(group, "transl", (count, 3), where), betas


def _cameras(
    poses: np.ndarray,
    transl: np.ndarray,
    world_poses: np.ndarray,
    world_transl: np.ndarray,
    pelvis: np.ndarray,
) -> np.ndarray:
    """World to camera (T, 4, 4), which takes the body in the world to that in the camera."""
    root, world_root = (Rotation.from_rotvec(p[:, 0]) for p in (poses, world_poses))
    cameras = np.tile(np.eye(4), (len(poses), 1, 1))
    turn = (root * world_root.inv()).as_matrix()
    cameras[:, :3, :3] = turn
    cameras[:, :3, 3] = pelvis + transl - (turn @ (pelvis + world_transl)[:, :, None])[:, :, 0]
    return cameras
