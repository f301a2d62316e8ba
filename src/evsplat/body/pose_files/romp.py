"""ROMP and BEV: one ``<frame>.npz`` per image or ``video_results.npz``, SMPL in the camera."""

import re
from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import choose_person, has, numbers
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_FOCAL_512 = 443.4
_KEYS = ("smpl_thetas", "smpl_betas", "cam_trans")
_BEV_NOTE = (
    "BEV centres the body between the hips of its own regressor, so that the translation is off "
    "by the few centimetres from there to the pelvis; its child coefficient is left out."
)


def fits(content: Any) -> bool:
    """Whether the content is that of ROMP or BEV."""
    if not has(content, "results"):
        return False
    results = content["results"]
    return has(results, *_KEYS) or (
        isinstance(results, dict)
        and bool(results)
        and all(has(r, *_KEYS) for r in results.values())
    )


def read(documents: list[Document], request: Request) -> PoseSequence:
    """In the camera, whose focal length ROMP fixes (443.4 pixels for a square of 512)."""
    where = str(request.path)
    if request.world:
        raise DataError(f"{where}: ROMP knows no world but the camera (world=False).")
    seen: dict[str, list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]] = {}
    for frame, results, place in _frames(documents):
        thetas = numbers(results, "smpl_thetas", (None, 72), place)
        betas = numbers(results, "smpl_betas", (len(thetas), None), place)
        shifts = numbers(results, "cam_trans", (len(thetas), 3), place)
        tracked = "track_ids" in results
        if len(thetas) > 1 and not tracked:
            raise DataError(
                f"{place}: {len(thetas)} people without track_ids; run ROMP with "
                "--temporal_optimize, or with --show_largest for the largest one only."
            )
        names = np.ravel(results["track_ids"]) if tracked else ["0"]
        if len(names) != len(thetas):
            raise DataError(f"{place}: {len(names)} track_ids for {len(thetas)} people.")
        for slot, name in enumerate(names):
            found = seen.setdefault(str(name), [])
            found.append((frame, thetas[slot], betas[slot], shifts[slot]))
    person = choose_person(
        {name: len(items) for name, items in seen.items()}, request.person, where
    )
    frames, poses, shapes, transl = zip(*seen[person], strict=True)
    is_bev = len(shapes[0]) == 11
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=np.array(poses).reshape(-1, 24, 3),
        transl=np.array(transl),
        betas=np.array([shape[:10] for shape in shapes]),
        source=where,
        world="camera",
        person=person,
        K=_camera(request.image_size),
        notes=(_BEV_NOTE,) if is_bev else (),
    )


def _frames(documents: list[Document]) -> list[tuple[int, Any, str]]:
    """Frame number, results and place of every image."""
    frames = []
    for document in documents:
        results = document.content["results"]
        if has(results, *_KEYS):
            frames.append((document.number, results, str(document.path)))
            continue
        for name, entry in results.items():
            digits = re.findall(r"\d+", str(name))
            number = int(digits[-1][-15:]) if digits else len(frames)
            frames.append((number, entry, f"{document.path}: {name}"))
    return frames


def _camera(size: tuple[int, int] | None) -> np.ndarray | None:
    if size is None:
        return None
    width, height = size
    focal = _FOCAL_512 * max(size) / 512
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
