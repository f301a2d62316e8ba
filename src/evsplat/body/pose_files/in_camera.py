"""Tools whose files pose SMPL in the camera alone: WHAM, PHALP, ROMP and BEV."""

import re
from typing import Any

import numpy as np

from evsplat.body.pose_files.documents import Document, Request
from evsplat.body.pose_files.fields import (
    all_have,
    axis_angles,
    choose_person,
    has,
    numbers,
    pinhole,
    whole_numbers,
)
from evsplat.body.pose_files.sequence import PoseSequence, make_sequence
from evsplat.errors import DataError

_PHALP_KEYS = ("tid", "smpl", "camera", "size", "time")
_PHALP_FOCAL = 5000 / 256
"""Focal length over the picture's longer side."""
_ROMP_KEYS = ("smpl_thetas", "smpl_betas", "cam_trans")
_ROMP_FOCAL = 443.4 / 512
"""Focal length over the picture's longer side."""
_BEV_NOTE = (
    "BEV centres the body between the hips of its own regressor, so that the translation is off "
    "by the few centimetres from there to the pelvis; its child coefficient is left out."
)


def fits_wham(content: Any) -> bool:
    """True for ``wham_output.pkl``: one entry per person."""
    return all_have(content, "pose", "trans", "betas", "frame_ids")


def read_wham(documents: list[Document], request: Request) -> PoseSequence:
    """SMPL in the camera; WHAM assumes a focal length of the image's diagonal."""
    content, where = documents[0].content, str(documents[0].path)
    if request.world:
        raise DataError(
            f"{where}: WHAM puts its world's origin between hips that only its own regressor of "
            "the licensed mesh finds; read its poses in the camera (world=False)."
        )
    people = {
        str(name): np.shape(entry["pose"])[0] if np.ndim(entry["pose"]) else 0
        for name, entry in content.items()
    }
    person = choose_person(people, request.person, where)
    entry = next(entry for name, entry in content.items() if str(name) == person)
    where = f"{where}: person {person}"
    poses = numbers(entry, "pose", (None, 72), where)
    count, size = len(poses), request.image_size
    return make_sequence(
        model="smpl",
        frames=whole_numbers(entry, "frame_ids", count, where),
        poses=poses.reshape(count, 24, 3),
        transl=numbers(entry, "trans", (count, 3), where, flat=True),
        betas=numbers(entry, "betas", (count, 10), where, flat=True),
        source=str(documents[0].path),
        world="camera",
        pose_source="estimated",
        person=person,
        K=None if size is None else pinhole(float(np.hypot(*size)), *size),
    )


def fits_phalp(content: Any) -> bool:
    """True for PHALP's (4D-Humans') ``results/demo_<name>.pkl``: one entry per picture."""
    return all_have(content, *_PHALP_KEYS)


def read_phalp(documents: list[Document], request: Request) -> PoseSequence:
    """SMPL in the camera; where a person was only predicted and not seen, there is no pose."""
    content, where = documents[0].content, str(documents[0].path)
    _refuse_world(request, where, "PHALP")
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
    counts = {name: len(items) for name, items in seen.items()}
    person = choose_person(counts, request.person, where)
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
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=np.array(poses),
        transl=np.array(transl),
        betas=np.array(betas),
        source=where,
        world="camera",
        pose_source="estimated",
        person=person,
        K=pinhole(_PHALP_FOCAL * max(height, width), width, height),
    )


def fits_romp(content: Any) -> bool:
    """True for ROMP and BEV: one ``<frame>.npz`` per image, or ``video_results.npz``."""
    if not has(content, "results"):
        return False
    results = content["results"]
    return has(results, *_ROMP_KEYS) or all_have(results, *_ROMP_KEYS)


def read_romp(documents: list[Document], request: Request) -> PoseSequence:
    """SMPL in the camera, whose focal length ROMP fixes (443.4 pixels for a square of 512)."""
    where = str(request.path)
    _refuse_world(request, where, "ROMP")
    seen: dict[str, list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]] = {}
    for frame, results, place in _romp_frames(documents):
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
    counts = {name: len(items) for name, items in seen.items()}
    person = choose_person(counts, request.person, where)
    frames, poses, shapes, transl = zip(*seen[person], strict=True)
    size = request.image_size
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=np.array(poses).reshape(-1, 24, 3),
        transl=np.array(transl),
        betas=np.array([shape[:10] for shape in shapes]),
        source=where,
        world="camera",
        pose_source="estimated",
        person=person,
        K=None if size is None else pinhole(_ROMP_FOCAL * max(size), *size),
        notes=(_BEV_NOTE,) if len(shapes[0]) == 11 else (),
    )


def _romp_frames(documents: list[Document]) -> list[tuple[int, Any, str]]:
    """Frame number, results and place of every image."""
    frames = []
    for document in documents:
        results = document.content["results"]
        if has(results, *_ROMP_KEYS):
            frames.append((document.number, results, str(document.path)))
            continue
        for name, entry in results.items():
            digits = re.findall(r"\d+", str(name))
            number = int(digits[-1][-15:]) if digits else len(frames)
            frames.append((number, entry, f"{document.path}: {name}"))
    return frames


def _refuse_world(request: Request, where: str, tool: str) -> None:
    if request.world:
        raise DataError(f"{where}: {tool} knows no world but the camera (world=False).")
