"""PHALP (4D-Humans): ``results/demo_<name>.pkl``, SMPL in the camera of a padded square."""

from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import axis_angles, choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_FOCAL_OF_LONGER_SIDE = 5000 / 256
_KEYS = ("tid", "smpl", "camera", "size", "time")


def fits(content: Any) -> bool:
    """Whether the content is that of PHALP."""
    return (
        isinstance(content, dict)
        and bool(content)
        and all(has(entry, *_KEYS) for entry in content.values())
    )


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In the camera; where a person was only predicted and not seen, there is no pose."""
    content, where = documents[0].content, str(documents[0].path)
    if request.world:
        raise DataError(f"{where}: PHALP knows no world but the camera (world=False).")
    seen: dict[str, list[tuple[dict, int, str]]] = {}
    for name, entry in content.items():
        place = f"{where}: {name}"
        lists = [entry[key] for key in ("tid", "smpl", "camera", "size")]
        if any(not isinstance(values, list) or len(values) != len(lists[0]) for values in lists):
            raise DataError(f"{place}: tid, smpl, camera and size must be lists of one length.")
        observed = entry.get("tracked_ids")
        for slot, person in enumerate(entry["tid"]):
            if not isinstance(observed, list) or person in observed:
                seen.setdefault(str(person), []).append((entry, slot, place))
    person = choose_person(
        {name: len(items) for name, items in seen.items()}, request.person, where
    )
    poses, transl, betas, frames, sizes = [], [], [], [], []
    for entry, slot, place in seen[person]:
        body = entry["smpl"][slot]
        root = numbers(body, "global_orient", (1, 3, 3), place, flat=True)
        rest = numbers(body, "body_pose", (23, 3, 3), place)
        poses.append(axis_angles(np.concatenate((root, rest)), place))
        betas.append(numbers(body, "betas", (10,), place, flat=True))
        transl.append(numbers({"camera": entry["camera"][slot]}, "camera", (3,), place, flat=True))
        sizes.append(numbers({"size": entry["size"][slot]}, "size", (2,), place))
        frames.append(int(numbers(entry, "time", (), place)))
    height, width = sizes[0]
    focal = _FOCAL_OF_LONGER_SIDE * max(height, width)
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=np.array(poses),
        transl=np.array(transl),
        betas=np.array(betas),
        source=where,
        world="camera",
        person=person,
        K=np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]),
    )
