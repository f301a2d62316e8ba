"""NumPy's files (.npy, .npz) and tables of numbers; their pickled objects are read safely or not.

An array's header is compared with the bytes that are there before memory is taken for it.
"""

import io
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Float64

from evsplat.errors import DataError
from evsplat.untrusted.faults import BROKEN, ordinary_file, reason
from evsplat.untrusted.pickles import StandIns, Unpickler, read_guarded
from evsplat.untrusted.sizes import count_of, open_zip, sound_text
from evsplat.untrusted.text import read_text

_KINDS = "biufcSU"
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class _HoldsObjects(Exception):
    """An array of Python objects where plain ones are expected."""


def read_npy(path: Path, *, what: str = "npy file", stand_ins: StandIns | None = None) -> Any:
    """The array of a .npy; what was wrapped in a 0-d object array comes bare.

    ``what`` says in messages what the file should be.

    Raises:
        DataError: unreadable, or holding a type that is neither an array nor a plain container.
    """

    def read() -> Any:
        with path.open("rb") as stream:
            return _array(stream, path.stat().st_size, lambda: _unpickle(stream, stand_ins))

    return read_guarded(path, what, read)


def read_npz(
    path: Path,
    *,
    what: str = "npz archive",
    keys: Collection[str] | None = None,
    stand_ins: StandIns | None = None,
) -> dict[str, Any]:
    """The members of a .npz, all or those of ``keys``, each as `read_npy` gives it."""

    def read() -> dict[str, Any]:
        return {
            key: _array(stream, size, lambda stream=stream: _unpickle(stream, stand_ins))
            for key, stream, size in _members(path, keys)
        }

    return read_guarded(path, what, read)


def read_plain_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz of numbers and texts; one of objects is a `DataError`."""
    ordinary_file(path)
    try:
        return {key: _array(stream, size) for key, stream, size in _members(path)}
    except _HoldsObjects:
        raise DataError(
            f"{path}: holds pickled Python objects, expected plain arrays only; save it with plain "
            "numeric and string arrays (np.savez never pickles those)."
        ) from None
    except BROKEN as error:
        raise DataError(f"{path}: not a readable npz ({reason(error)}); write it anew.") from error


def read_plain_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a .npz by name, or the one of a .npy under ""; objects are a `DataError`."""
    ordinary_file(path)
    try:
        with path.open("rb") as stream:
            if stream.read(2) != b"PK":
                stream.seek(0)
                return {"": _array(stream, path.stat().st_size)}
        return {key: _array(stream, size) for key, stream, size in _members(path)}
    except _HoldsObjects:
        raise DataError(
            f"{path}: not a readable NumPy file (it holds Python objects, which are not read from "
            "files of others)."
        ) from None
    except BROKEN as error:
        raise DataError(f"{path}: not a readable NumPy file ({reason(error)}).") from error


def read_table(
    source: Path | IO[bytes] | IO[str], *, rows: int | None = None
) -> Float64[np.ndarray, "rows columns"]:
    """Numbers in lines of plain text, the first ``rows`` or all; a `ValueError` where others.

    A path that leads to no ordinary text is a `DataError`.
    """
    if isinstance(source, Path):
        source = io.StringIO(read_text(source))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # empty lines, no lines
            return np.loadtxt(source, ndmin=2, max_rows=rows, dtype=np.float64)
    except BROKEN as error:
        raise ValueError(reason(error)) from None


def _members(
    path: Path, keys: Collection[str] | None = None
) -> Iterator[tuple[str, IO[bytes], int]]:
    """Name, opened stream and unpacked size of each array of an archive."""
    with open_zip(str(path)) as archive:
        # of two members of one name the last counts, as in NumPy's reader
        found = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        for key, info in found.items():
            if keys is None or key in keys:
                with archive.open(info) as stream:
                    yield key, stream, info.file_size


def _array(stream: IO[bytes], size: int, unpickle: Any = None) -> Any:
    """One array in npy format, in ``size`` bytes; ``unpickle`` reads the objects of one."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version[0]}.{version[1]} of the .npy format")
    shape, fortran_order, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        if unpickle is None:
            raise _HoldsObjects
        return unpickle()
    if any(kind not in _KINDS for kind in _kinds(dtype)):
        raise ValueError(f"an array of {dtype}")
    count = count_of(shape)
    if count * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape} in {size} bytes")
    data = stream.read(count * dtype.itemsize)
    array = sound_text(np.frombuffer(data, dtype, count).copy())
    return array.reshape(shape, order="F" if fortran_order else "C")


def _kinds(dtype: np.dtype) -> str:
    """Letters of the kinds of numbers and texts in an array, those of its fields one by one."""
    if dtype.subdtype is not None:
        return _kinds(dtype.subdtype[0])
    if dtype.fields is None:
        return dtype.kind
    return "".join(_kinds(field[0]) for field in dtype.fields.values())


def _unpickle(stream: IO[bytes], stand_ins: StandIns | None) -> Any:
    value = Unpickler(stream, stand_ins).load()
    is_wrapped = isinstance(value, np.ndarray) and value.shape == ()
    return value.item() if is_wrapped else value
