"""Poses as data sets store them: AMASS, ARAH's ZJU-MoCap, MMHPSD."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_AMASS_MODELS = {72: "smpl", 156: "smplh", 165: "smplx"}
_AMASS_RATES = ("mocap_framerate", "mocap_frame_rate")
_ARAH_PARTS = (("root_orient", 3), ("pose_body", 63), ("pose_hand", 6))
_MMHPSD_PARTS = (("betas", 10), ("thetas", 72), ("translation", 3))
_MMHPSD_K = np.array([[1679.3, 0, 641], [0, 1679.3, 641], [0, 0, 1280]]) * 256 / 1280
_MMHPSD_K[2, 2] = 1


def fits_amass(content: Any) -> bool:
    """True for AMASS and files like it: one ``.npz`` with poses, trans, betas and a frame rate."""
    return has(content, "poses", "trans", "betas")


def read_amass(documents: list[Document], request: Request) -> PoseSequence:
    """Poses in the file's own world with z up."""
    content, where = documents[0].content, str(documents[0].path)
    poses = numbers(content, "poses", (None, None), where)
    count, width = poses.shape
    if width not in _AMASS_MODELS:
        raise DataError(
            f"{where}: poses has {width} numbers per frame, expected 72 (SMPL), 156 (SMPL-H) or "
            "165 (SMPL-X)."
        )
    rate = next((key for key in _AMASS_RATES if key in content), None)
    gender = content.get("gender", "neutral")
    gender = np.ravel(np.asarray(gender))[0] if np.size(gender) else "neutral"
    return make_sequence(
        model=_AMASS_MODELS[width],
        frames=np.arange(count),
        poses=poses.reshape(count, -1, 3),
        transl=numbers(content, "trans", (count, 3), where),
        betas=numbers(content, "betas", (None,), where, flat=True),
        gender=gender.decode("latin1") if isinstance(gender, bytes) else str(gender),
        source=where,
        world="z up",
        # others write such files of what they estimated, without this rate
        pose_source=None if rate is None else "markers",
        person=choose_person({"0": count}, request.person, where),
        fps=None if rate is None else float(numbers(content, rate, (1,), where, flat=True)[0]),
    )


def fits_arah(content: Any) -> bool:
    """True for ZJU-MoCap as ARAH and 3DGS-Avatar prepare it: ``models/<frame>.npz``, SMPL."""
    return has(content, *(key for key, _ in _ARAH_PARTS), "trans", "betas")


def read_arah(documents: list[Document], request: Request) -> PoseSequence:
    """Poses in the world of the calibrated cameras; the root already turns about the pelvis."""
    poses, transl, betas = [], [], []
    person = choose_person({"0": len(documents)}, request.person, str(request.path))
    for document in documents:
        content, where = document.content, str(document.path)
        vectors = [numbers(content, key, (size,), where, flat=True) for key, size in _ARAH_PARTS]
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
        pose_source="markers",
        person=person,
    )


def fits_mmhpsd(content: Any) -> bool:
    """True for MMHPSD's ``pose<frame>.pkl``: betas, thetas, translation, joints, pixels."""
    if not isinstance(content, tuple | list) or len(content) != 5:
        return False
    found = [np.size(part) for part in content[:3] if isinstance(part, np.ndarray)]
    return found == [size for _, size in _MMHPSD_PARTS]


def read_mmhpsd(documents: list[Document], request: Request) -> PoseSequence:
    """SMPL in the grey camera, whose pictures are 256 pixels wide and high."""
    where = str(request.path)
    if request.world:
        raise DataError(f"{where}: MMHPSD knows no world but the camera (world=False).")
    person = choose_person({"0": len(documents)}, request.person, where)
    read_parts = [
        [
            numbers({name: part}, name, (size,), str(document.path), flat=True)
            for (name, size), part in zip(_MMHPSD_PARTS, document.content, strict=False)
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
        pose_source="markers",
        person=person,
        K=_MMHPSD_K,
    )
