"""Checked access to what a pose file holds."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from evsplat.errors import DataError


def has(content: Any, *keys: str) -> bool:
    """True for a mapping with all the keys."""
    return isinstance(content, Mapping) and all(key in content for key in keys)


def all_have(content: Any, *keys: str) -> bool:
    """True for a dictionary of one or more entries that all have the keys."""
    return (
        isinstance(content, dict)
        and bool(content)
        and all(has(entry, *keys) for entry in content.values())
    )


def numbers(
    content: Any, key: str, shape: tuple[int | None, ...], where: str, *, flat: bool = False
) -> np.ndarray:
    """Finite float64 numbers of a shape (None: any length); ``flat`` reshapes to it first.

    Raises:
        DataError: missing, no numbers, another shape, or not finite.
    """
    if not has(content, key):
        raise DataError(f"{where}: no '{key}', which this kind of file has.")
    value = content[key]
    try:
        array = np.asarray(value, np.float64)
        if flat:
            array = array.reshape([-1 if size is None else size for size in shape])
    except (ValueError, TypeError, OverflowError):
        wanted, found = _words(shape), _words(getattr(value, "shape", None))
        raise DataError(f"{where}: {key} is {found}, expected numbers of shape {wanted}.") from None
    fits = array.ndim == len(shape) and all(
        want in (None, size) for want, size in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise DataError(f"{where}: {key} has shape {array.shape}, expected {_words(shape)}.")
    if array.size == 0:
        raise DataError(f"{where}: {key} is empty, expected {_words(shape)}.")
    if not np.isfinite(array).all():
        raise DataError(f"{where}: {key} holds values that are not finite.")
    # A file spoilt on its way holds numbers that would overflow further on.
    if (np.abs(array) > 1e9).any():
        raise DataError(f"{where}: {key} holds values beyond 1e9; the file is damaged.")
    return array


def whole_numbers(content: Any, key: str, count: int, where: str) -> np.ndarray:
    """A field of ``count`` whole numbers, such as frame indices."""
    values = numbers(content, key, (count,), where, flat=True)
    if (values != np.rint(values)).any():
        raise DataError(f"{where}: {key} holds fractions, expected whole numbers.")
    return values.astype(np.int64)


def axis_angles(matrices: np.ndarray, where: str) -> np.ndarray:
    """Axis-angle vectors (..., 3) of rotation matrices (..., 3, 3)."""
    flat = matrices.reshape(-1, 3, 3)
    off = np.abs(flat @ flat.swapaxes(1, 2) - np.eye(3)).max(initial=0.0)
    if off > 1e-2 or (np.linalg.det(flat) < 0).any():
        raise DataError(f"{where}: holds matrices that are no rotations (off by {off:.2g}).")
    return Rotation.from_matrix(flat).as_rotvec().reshape(*matrices.shape[:-2], 3)


def pinhole(focal_px: float, width: float, height: float) -> np.ndarray:
    """Intrinsics (3, 3) with the principal point in the middle of the picture."""
    return np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])


def choose_person(people: Mapping[str, int], person: str | int | None, where: str) -> str:
    """The person meant: the only one, or the one named; ``people`` maps names to pose counts."""
    candidates = ", ".join(f"{name} ({count} frames)" for name, count in people.items())
    if not people:
        raise DataError(f"{where}: holds no person.")
    if person is None:
        if len(people) > 1:
            raise DataError(
                f"{where}: holds {len(people)} people: {candidates}; choose one with person=."
            )
        return next(iter(people))
    if str(person) not in people:
        raise DataError(f"{where}: no person '{person}'; the file has {candidates}.")
    return str(person)


def _words(shape: tuple[int | None, ...] | None) -> str:
    if shape is None:
        return "no array"
    inner = ", ".join("any" if size is None else str(size) for size in shape)
    return f"({inner}{',' if len(shape) == 1 else ''})"
