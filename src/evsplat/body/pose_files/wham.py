"""WHAM: ``wham_output.pkl``, SMPL in the camera, one entry per person."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers, whole_numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError


def fits(content: Any) -> bool:
    """Whether the content is that of WHAM."""
    return (
        isinstance(content, dict)
        and bool(content)
        and all(has(entry, "pose", "trans", "betas", "frame_ids") for entry in content.values())
    )


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In the camera; WHAM assumes a focal length of the image's diagonal."""
    content, where = documents[0].content, str(documents[0].path)
    if request.world:
        raise DataError(
            f"{where}: WHAM puts its world's origin between hips that only its own regressor of "
            "the licensed mesh finds; read its poses in the camera (world=False)."
        )
    people = {str(name): np.shape(entry["pose"])[0] if np.ndim(entry["pose"]) else 0
              for name, entry in content.items()}  # fmt: skip
    person = choose_person(people, request.person, where)
    entry = next(entry for name, entry in content.items() if str(name) == person)
    where = f"{where}: person {person}"
    poses = numbers(entry, "pose", (None, 72), where)
    count = len(poses)
    return make_sequence(
        model="smpl",
        frames=whole_numbers(entry, "frame_ids", count, where),
        poses=poses.reshape(count, 24, 3),
        transl=numbers(entry, "trans", (count, 3), where, flat=True),
        betas=numbers(entry, "betas", (count, 10), where, flat=True),
        source=str(documents[0].path),
        world="camera",
        person=person,
        K=_diagonal_camera(request.image_size),
    )


def _diagonal_camera(size: tuple[int, int] | None) -> np.ndarray | None:
    if size is None:
        return None
    width, height = size
    focal = np.hypot(width, height)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
