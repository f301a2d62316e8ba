"""MMHPSD (EventHPE): ``pose_events/<action>/pose<frame>.pkl``, SMPL in the camera."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_K_256 = np.array([[1679.3, 0, 641], [0, 1679.3, 641], [0, 0, 1280]]) * 256 / 1280
_K_256[2, 2] = 1
_SIZES = (("betas", 10), ("thetas", 72), ("translation", 3))


def fits(content: Any) -> bool:
    """Whether the content is that of MMHPSD: betas, thetas, translation, joints, pixels."""
    if not isinstance(content, tuple | list) or len(content) != 5:
        return False
    found = [np.size(part) for part in content[:3] if isinstance(part, np.ndarray)]
    return found == [size for _, size in _SIZES]


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In the grey camera, whose pictures are 256 pixels wide and high."""
    where = str(request.path)
    if request.world:
        raise DataError(f"{where}: MMHPSD knows no world but the camera (world=False).")
    person = choose_person({"0": len(documents)}, request.person, where)
    read_parts = [
        [
            numbers({name: part}, name, (size,), str(document.path), flat=True)
            for (name, size), part in zip(_SIZES, document.content, strict=False)
        ]
        for document in documents
    ]
    betas, thetas, transl = (np.array(part) for part in zip(*read_parts, strict=True))
    return make_sequence(
        model="smpl",
        frames=[document.number for document in documents],
        poses=thetas.reshape(-1, 24, 3),
        transl=transl,
        betas=betas,
        source=where,
        world="camera",
        person=person,
        K=_K_256,
    )
