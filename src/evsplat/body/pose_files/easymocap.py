"""EasyMocap (``<frame>.json``) and ZJU-MoCap (``new_params/<frame>.npy``): SMPL family.

Their root turns about the origin of the model and not about the pelvis:
``v = R(Rh) smpl(poses, shapes) + Th``.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence, moved
from evsplat.errors import DataError

_KEYS = ("Rh", "Th", "poses", "shapes")
_MODELS = {72: "smpl", 69: "smpl", 78: "smplh", 156: "smplh", 87: "smplx", 165: "smplx"}
"""Model by the size of ``poses``; 78 and 87 end in hand components that need the model."""


def fits(content: Any) -> bool:
    """True for people with root, poses and shapes as EasyMocap and ZJU-MoCap name them."""
    people = _people(content)
    return bool(people) and all(has(entry, *_KEYS) for entry in people)


def read(documents: list[Document], request: Request) -> PoseSequence:
    """Poses in the world of the calibrated cameras."""
    where = str(request.path)
    seen: dict[str, list[tuple[Document, dict]]] = {}
    for document in documents:
        for entry in _people(document.content):
            seen.setdefault(str(entry.get("id", 0)), []).append((document, entry))
    person = choose_person(
        {name: len(items) for name, items in seen.items()}, request.person, where
    )
    roots, shifts, poses, betas = [], [], [], []
    model = None
    for document, entry in seen[person]:
        place = str(document.path)
        values = numbers(entry, "poses", (None,), place, flat=True)
        if _MODELS.get(len(values)) is None or model not in (None, _MODELS[len(values)]):
            raise DataError(
                f"{place}: poses has {len(values)} numbers, expected the same of "
                f"{', '.join(map(str, _MODELS))} in all frames."
            )
        model = _MODELS[len(values)]
        poses.append(_local(values))
        roots.append(numbers(entry, "Rh", (3,), place, flat=True))
        shifts.append(numbers(entry, "Th", (3,), place, flat=True))
        betas.append(numbers(entry, "shapes", (None,), place, flat=True))
    assert model is not None
    if len({len(shape) for shape in betas}) > 1:
        raise DataError(f"{where}: frames have different numbers of shapes.")
    shape = np.array(betas)
    pelvis = request.pelvis(model, shape, where)
    turned, transl = moved(
        np.array(poses),
        np.zeros((len(poses), 3)),
        Rotation.from_rotvec(roots).as_matrix(),
        np.array(shifts),
        pelvis,
    )
    hands = "Fingers are at rest: their components need the model."
    return make_sequence(
        model=model,
        frames=[document.number for document, _ in seen[person]],
        poses=turned,
        transl=transl,
        betas=shape,
        source=where,
        world="calibration",
        pose_source="markers",
        person=person,
        notes=(hands,) if len(values) in (78, 87) else (),
    )


def _people(content: Any) -> list[dict]:
    entries = content["annots"] if has(content, "annots") else content
    entries = [entries] if isinstance(entries, dict) else entries
    if not isinstance(entries, list):
        return []
    return [entry if isinstance(entry, dict) else {} for entry in entries]


def _local(values: np.ndarray) -> np.ndarray:
    """Axis-angle vectors of the joints whose rotations the file spells out."""
    if len(values) == 69:  # without the root, which is Rh
        values = np.concatenate((np.zeros(3), values))
    if len(values) in (78, 87):
        values = values[:66]
    return values.reshape(-1, 3)
