"""Key points that other tools found, as `Landmarks`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from evsplat.errors import DataError
from evsplat.landmarks.keypoint_files import read_points
from evsplat.landmarks.landmarks import SETS, Landmarks

SIGMA_SHARE = 0.012
"""Error of a point that is surely seen, as a share of the person's height in the picture."""
LEAST_SEEN = 0.05
_LARGEST = 1e6
_LARGEST_SHARE = 2.0


def read_keypoints(path: Path | str, times_us: Sequence[int]) -> Landmarks:
    """One person's key points from a file (`read_points`), a row for each of the times.

    ``times_us`` are microseconds on the camera's clock and ascend.

    Places are pixels with the centre of the top left pixel at (0.5, 0.5); the third number is a
    confidence in 0..1 (1 where there is none), and what has next to none counts as not seen. Which
    set of points it is, their number says.

    Raises:
        DataError: missing, damaged, not in pixels, another count of frames or points, several
            people, or nobody.
    """
    path = Path(path)
    values = read_points(path)
    names = _names(path, values.shape[1])
    if len(values) != len(times_us):
        raise DataError(
            f"{path}: holds {len(values)} frames, expected {len(times_us)}, one for each picture "
            "of the recording; give the key points of all of its frames in their order."
        )
    # a point that was not found is stored as zeros, or as nothing at all
    known = np.isfinite(values).all(-1) & (values[..., :2] != 0).any(-1)
    values = np.where(known[..., None], values, 0.0)
    if np.abs(values).max(initial=0) > _LARGEST:
        raise DataError(
            f"{path}: holds values beyond {_LARGEST:g}, expected pixels; the file is damaged."
        )
    if known.any() and np.abs(values[..., :2]).max() <= _LARGEST_SHARE:
        raise DataError(
            f"{path}: all places lie within {_LARGEST_SHARE:g} of 0, expected pixels, not shares "
            "of the picture; multiply x with its width and y with its height."
        )
    confidence = values[..., 2] if values.shape[2] == 3 else np.ones(values.shape[:2])
    if confidence.min(initial=0) < 0 or confidence.max(initial=0) > 1.5:
        raise DataError(
            f"{path}: the third numbers run from {confidence.min():g} to {confidence.max():g}, "
            "expected confidences in 0..1; leave them out where there are none."
        )
    seen = np.where(known, confidence.clip(0, 1), 0.0)
    if not (seen > LEAST_SEEN).any(1).mean() > 0.5:
        raise DataError(
            f"{path}: shows nobody in {(seen <= LEAST_SEEN).all(1).sum()} of {len(seen)} frames, "
            "expected one person in most of them."
        )
    places = values[..., :2]
    base = SIGMA_SHARE * _height(places, seen)
    sigma = base / np.sqrt(np.maximum(seen, LEAST_SEEN))
    times = np.asarray(times_us, dtype=np.int64)
    return Landmarks(times, places, sigma, np.where(seen > LEAST_SEEN, seen, 0.0), None, names)


def _height(places: Float[np.ndarray, "N L 2"], seen: Float[np.ndarray, "N L"]) -> float:
    """The longer side of the person's box, pixels: high in the distribution over the frames."""
    sides = [
        np.ptp(row[near > LEAST_SEEN], axis=0).max()
        for row, near in zip(places, seen, strict=True)
        if (near > LEAST_SEEN).any()
    ]
    return max(1.0, float(np.percentile(sides, 80)))


def _names(path: Path, count: int) -> tuple[str, ...]:
    for names in SETS.values():
        if len(names) == count:
            return names
    raise DataError(
        f"{path}: holds {count} points, expected 17 (COCO), 25 (OpenPose BODY_25), 33 (BlazePose) "
        "or 133 (COCO-WholeBody)."
    )
