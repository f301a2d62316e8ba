"""Files of key points: OpenPose's and COCO's JSON, arrays of NumPy, tables.

Read are OpenPose's JSON (a folder with a file per frame, or one of them), COCO-style JSON (a list
of annotations or predictions, as MMPose and AlphaPose write), and arrays of frames x points x 2 or
3 in .npz, .npy or .csv.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from evsplat.errors import DataError
from evsplat.landmarks.landmarks import SETS
from evsplat.names import natural_order
from evsplat.untrusted.arrays import read_plain_arrays
from evsplat.untrusted.faults import brief, open_text, reason
from evsplat.untrusted.text import read_json

_KEYS = ("keypoints", "poses", "places", "joints", "landmarks", "arr_0")
_FORMS = "OpenPose or COCO-style JSON, .npz, .npy or .csv with frames x points x 2 or 3"


def read_points(path: Path) -> Float[np.ndarray, "N L D"]:
    """Numbers of a file or folder: x, y and perhaps a confidence of each point.

    Those of a frame that shows nobody are NaN.

    Raises:
        DataError: missing, damaged, another form, or several people.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"), key=lambda file: natural_order(file.name))
        if not files:
            raise DataError(f"{path}: holds no .json file, expected OpenPose's, one per frame.")
        frames = [_openpose(file, read_json(file)) for file in files]
        return _stack(path, frames)
    suffix = path.suffix.lower()
    if not path.is_file():
        raise DataError(f"{path}: file not found; give {_FORMS}.")
    if suffix == ".json":
        return _from_json(path, read_json(path))
    if suffix == ".csv":
        return _from_csv(path)
    if suffix in (".npz", ".npy"):
        return _from_arrays(path)
    raise DataError(f"{path}: is no known file of key points, expected {_FORMS}.")


def _from_json(path: Path, content: Any) -> Float[np.ndarray, "N L D"]:
    if isinstance(content, dict) and "people" in content:
        return _stack(path, [_openpose(path, content)])
    if isinstance(content, dict):
        content = content.get("annotations", content.get("instance_info"))
    if not isinstance(content, list) or not content:
        raise DataError(
            f"{path}: holds neither OpenPose's people nor a list of annotations with keypoints, "
            "expected one of them."
        )
    frames: dict[str, list[Any]] = {}
    for index, entry in enumerate(content):
        if not isinstance(entry, dict):
            raise DataError(f"{path}: entry {index} is {type(entry).__name__}, expected an object.")
        frame = entry.get("image_id", entry.get("frame_id", index))
        found = entry.get("instances", [entry])
        if not isinstance(found, list):
            raise DataError(f"{path}: entry {index}: instances is no list.")
        frames.setdefault(json.dumps(frame), []).extend(found)
    order = sorted(frames, key=natural_order)
    return _stack(path, [_one_person(path, f"frame {key[:80]}", frames[key]) for key in order])


def _one_person(path: Path, where: str, people: list[Any]) -> np.ndarray | None:
    if len(people) > 1:
        raise DataError(
            f"{path}: {where} shows {len(people)} people, expected one; leave only the one that "
            "was recorded."
        )
    if not people:
        return None
    person = people[0]
    if not isinstance(person, dict) or "keypoints" not in person:
        raise DataError(f"{path}: {where} has no keypoints, which COCO's annotations have.")
    values = _numbers(path, where, person["keypoints"])
    scores = person.get("keypoint_scores")
    if values.ndim == 2 and values.shape[1] >= 2 and scores is not None:
        scores = _numbers(path, where, scores)
        if scores.shape != values.shape[:1]:
            raise DataError(
                f"{path}: {where}: keypoint_scores has shape {scores.shape}, expected "
                f"{values.shape[:1]}."
            )
        values = np.c_[values[:, :2], scores]
    values = _triples(path, where, values) if values.ndim == 1 else values
    if values.ndim == 2 and values.shape[1] == 3 and _is_coco(values):
        values[:, 2] /= 2  # COCO's visibility: 0 not labelled, 1 hidden, 2 visible
    return values


def _is_coco(values: Float[np.ndarray, "L 3"]) -> bool:
    return bool(np.isin(values[:, 2], (0, 1, 2)).all() and (values[:, 2] == 2).any())


def _openpose(path: Path, content: Any) -> np.ndarray | None:
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise DataError(f"{path}: has no list of people, which OpenPose's files have.")
    if not people:
        return None
    if len(people) > 1:
        raise DataError(
            f"{path}: shows {len(people)} people, expected one; leave only the one recorded."
        )
    if not isinstance(people[0], dict) or "pose_keypoints_2d" not in people[0]:
        raise DataError(
            f"{path}: its person has no pose_keypoints_2d, which OpenPose's files have."
        )
    return _triples(path, "people[0]", _numbers(path, "people[0]", people[0]["pose_keypoints_2d"]))


def _triples(path: Path, where: str, values: np.ndarray) -> Float[np.ndarray, "L 3"]:
    if values.ndim != 1 or values.size % 3:
        raise DataError(
            f"{path}: {where} has {values.size} numbers, expected x, y, confidence of each point."
        )
    return values.reshape(-1, 3)


def _numbers(path: Path, where: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise DataError(f"{path}: {where} holds something else than numbers.") from None


def _stack(path: Path, frames: Sequence[np.ndarray | None]) -> Float[np.ndarray, "N L D"]:
    """Frames as one array; those with nobody are NaN."""
    shapes = {frame.shape for frame in frames if frame is not None}
    if not shapes:
        raise DataError(f"{path}: shows nobody in any of {len(frames)} frames.")
    if len(shapes) > 1:
        raise DataError(
            f"{path}: frames have points of shapes {brief(sorted(shapes))}, expected one."
        )
    (shape,) = shapes
    if len(shape) != 2 or shape[1] not in (2, 3):
        raise DataError(f"{path}: points of a frame have shape {shape}, expected (points, 2 or 3).")
    nobody = np.full(shape, np.nan)
    return np.stack([nobody if frame is None else frame for frame in frames])


def _from_arrays(path: Path) -> Float[np.ndarray, "N L D"]:
    arrays = read_plain_arrays(path)
    array = next((arrays[key] for key in ("", *_KEYS) if key in arrays), None)
    if array is None:
        raise DataError(
            f"{path}: holds {', '.join(arrays)[:300] or 'nothing'}, expected an array "
            f"{' or '.join(_KEYS)}."
        )
    return _checked(path, array)


def _from_csv(path: Path) -> Float[np.ndarray, "N L D"]:
    """Rows of frames; x, y and perhaps confidence of each point one after the other."""
    try:
        with open_text(path, newline="") as stream:
            rows = [row for row in csv.reader(stream) if row]
        # a cell is empty where a point was not found, also the first one of the first frame
        first = 0 if rows and all(not cell or _is_number(cell) for cell in rows[0]) else 1
        array = np.array([[float(cell or "nan") for cell in row] for row in rows[first:]])
    except (ValueError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(
            f"{path}: not a table of numbers ({reason(error)}), expected a row per frame with x, y "
            "(and confidence) of each point, after at most one line of names."
        ) from error
    if array.ndim != 2 or not array.size:
        raise DataError(f"{path}: holds no rows of numbers.")
    for size in (3, 2):
        counts = [len(names) for names in SETS.values()]
        if array.shape[1] % size == 0 and array.shape[1] // size in counts:
            return array.reshape(len(array), -1, size)
    raise DataError(
        f"{path}: rows have {array.shape[1]} numbers, expected 2 or 3 for each of 17, 25, 33 or "
        "133 points."
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _checked(path: Path, array: np.ndarray) -> Float[np.ndarray, "N L D"]:
    if array.dtype.kind not in "fiu" or array.ndim != 3 or array.shape[2] not in (2, 3):
        raise DataError(
            f"{path}: the array has shape {array.shape} of {array.dtype}, expected numbers of "
            "(frames, points, 2 or 3)."
        )
    return array.astype(np.float64)
