"""TRAM: ``hps/hps_track_<k>.npy`` per person with ``camera.npy`` beside the folder, SMPL."""

from pathlib import Path
from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request, open_document
from evsplat.body.pose_files.fields import axis_angles, choose_person, has, numbers, whole_numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence, moved
from evsplat.errors import DataError


def fits(content: Any) -> bool:
    """True for a person's ``hps_track_<k>.npy``."""
    return has(content, "pred_rotmat", "pred_trans", "pred_shape", "frame")


def read(documents: list[Document], request: Request) -> PoseSequence:
    """Poses in the camera, or (``world``) in the world of its SLAM with the moving camera in it."""
    people = {str(document.number): np.size(document.content["frame"]) for document in documents}
    person = choose_person(people, request.person, str(request.path))
    document = next(document for document in documents if str(document.number) == person)
    content, where = document.content, str(document.path)
    matrices = numbers(content, "pred_rotmat", (None, 24, 3, 3), where)
    count = len(matrices)
    poses = axis_angles(matrices, f"{where}: pred_rotmat")
    transl = numbers(content, "pred_trans", (count, 3), where, flat=True)
    betas = numbers(content, "pred_shape", (count, 10), where)
    frames = whole_numbers(content, "frame", count, where)
    camera = _camera(document.path)
    intrinsics = None if camera is None else _intrinsics(camera)
    world_to_camera = None
    if request.world:
        if camera is None:
            raise DataError(
                f"{where}: no camera.npy beside it or above its folder, which the world needs."
            )
        turn, shift = _track(camera, frames)
        pelvis = request.pelvis("smpl", betas, where)
        poses, transl = moved(poses, transl, turn, shift, pelvis)
        world_to_camera = np.tile(np.eye(4), (count, 1, 1))
        world_to_camera[:, :3, :3] = turn.swapaxes(1, 2)
        world_to_camera[:, :3, 3] = -(turn.swapaxes(1, 2) @ shift[:, :, None])[:, :, 0]
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=poses,
        transl=transl,
        betas=betas,
        source=where,
        world="y down" if request.world else "camera",
        pose_source="estimated",
        person=person,
        K=intrinsics,
        world_to_camera=world_to_camera,
    )


def _camera(path: Path) -> Document | None:
    for folder in (path.parent, path.parent.parent):
        if (folder / "camera.npy").is_file():
            return open_document(folder / "camera.npy")
    return None


def _intrinsics(camera: Document) -> np.ndarray:
    where = str(camera.path)
    focal = numbers(camera.content, "img_focal", (1,), where, flat=True)[0]
    centre = numbers(camera.content, "img_center", (2,), where, flat=True)
    return np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])


def _track(camera: Document, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Camera to world at the given frames."""
    where = str(camera.path)
    turns = numbers(camera.content, "pred_cam_R", (None, 3, 3), where)
    shifts = numbers(camera.content, "pred_cam_T", (len(turns), 3), where)
    if frames.max() >= len(turns) or frames.min() < 0:
        raise DataError(
            f"{where}: has {len(turns)} cameras, but the person is there in frame "
            f"{frames.max()}; both must come from one run."
        )
    axis_angles(turns, f"{where}: pred_cam_R")
    return turns[frames], shifts[frames]
