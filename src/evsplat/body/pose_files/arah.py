"""ZJU-MoCap as ARAH and 3DGS-Avatar prepare it: ``models/<frame>.npz``, SMPL."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence

_KEYS = ("root_orient", "pose_body", "pose_hand", "trans", "betas")


def fits(content: Any) -> bool:
    """Whether the content is that of ARAH."""
    return has(content, *_KEYS)


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In the world of the calibrated cameras; the root already turns about the pelvis."""
    poses, transl, betas = [], [], []
    person = choose_person({"0": len(documents)}, request.person, str(request.path))
    for document in documents:
        content, where = document.content, str(document.path)
        parts = [("root_orient", 3), ("pose_body", 63), ("pose_hand", 6)]
        vectors = [numbers(content, key, (size,), where, flat=True) for key, size in parts]
        poses.append(np.concatenate(vectors).reshape(24, 3))
        transl.append(numbers(content, "trans", (3,), where, flat=True))
        betas.append(numbers(content, "betas", (10,), where, flat=True))
    return make_sequence(
        model="smpl",
        frames=[document.number for document in documents],
        poses=np.array(poses),
        transl=np.array(transl),
        betas=np.array(betas),
        source=str(request.path),
        world="calibration",
        person=person,
    )
