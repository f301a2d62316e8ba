"""AMASS and files like it: one ``.npz`` with poses, trans, betas and a frame rate."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_MODELS = {72: "smpl", 156: "smplh", 165: "smplx"}
_RATES = ("mocap_framerate", "mocap_frame_rate")


def fits(content: Any) -> bool:
    """Whether the content is that of AMASS."""
    return has(content, "poses", "trans", "betas")


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In its own world with z up."""
    content, where = documents[0].content, str(documents[0].path)
    poses = numbers(content, "poses", (None, None), where)
    count, width = poses.shape
    if width not in _MODELS:
        raise DataError(
            f"{where}: poses has {width} numbers per frame, expected 72 (SMPL), 156 (SMPL-H) or "
            "165 (SMPL-X)."
        )
    rate = next((key for key in _RATES if key in content), None)
    gender = content.get("gender", "neutral")
    gender = np.ravel(np.asarray(gender))[0] if np.size(gender) else "neutral"
    return make_sequence(
        model=_MODELS[width],
        frames=np.arange(count),
        poses=poses.reshape(count, -1, 3),
        transl=numbers(content, "trans", (count, 3), where),
        betas=numbers(content, "betas", (None,), where, flat=True),
        gender=gender.decode("latin1") if isinstance(gender, bytes) else str(gender),
        source=where,
        world="z up",
        person=choose_person({"0": count}, request.person, where),
        fps=None if rate is None else float(numbers(content, rate, (1,), where, flat=True)[0]),
    )
