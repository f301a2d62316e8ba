"""HDF5 files, whose links and packings may name other files and sizes that are not there."""

from pathlib import Path
from typing import Any

import h5py

from evsplat.errors import DataError
from evsplat.untrusted.faults import BROKEN, ordinary_file, reason

_MOST_PER_BYTE = 4096
"""Numbers per stored byte: no packing puts more into one, so that the rest is announced alone."""
_MOST_CHUNK_BYTES = 1 << 28
"""Of a piece that HDF5 unpacks whole; usual ones are of 1 MiB."""


def open_hdf5(path: Path, **options: Any) -> h5py.File:
    """An HDF5 file to read from; one that cannot be opened is a `DataError`."""
    ordinary_file(path)
    try:
        return h5py.File(path, "r", **options)
    except BROKEN as error:
        raise DataError(
            f"{path}: not a readable HDF5 file ({reason(error)}); copy it again or write it anew."
        ) from error


def holds(file: h5py.File, name: str) -> bool:
    """Whether something of that name is in the file; a `DataError` where its index is damaged."""
    try:
        return name in file
    except BROKEN as error:
        raise DataError(
            f"{file.filename}: {name}: cannot be looked up ({reason(error)}); copy the file again "
            "or write it anew."
        ) from error


def data_set(file: h5py.File, name: str) -> h5py.Dataset:
    """A data set of the file; a `DataError` where there is none, or none that is safe to read."""
    wrong = wrong_data_set(file, name)
    if wrong:
        raise DataError(
            f"{file.filename}: {name}: found {wrong}, expected a data set; copy the file again or "
            "write it anew."
        )
    return file[name]


def wrong_data_set(file: h5py.File, name: str) -> str:
    """What is there instead of a data set of that name; "" where it is one, and whole."""
    try:
        found = file.get(name)
        if not isinstance(found, h5py.Dataset) or found.shape is None:
            return "nothing"
        # A link to another file, or numbers kept in one.
        if found.file.filename != file.filename or found.external or found.is_virtual:
            return "a data set of another file"
        pieces = found.chunks or ()
        if _bytes_of(pieces, found.dtype.itemsize) > _MOST_CHUNK_BYTES:
            return f"pieces of {pieces}, too large to be unpacked"
        stored = found.id.get_storage_size()
        if found.size > _MOST_PER_BYTE * (stored + 1):
            return f"{found.size:,} numbers announced in {stored:,} bytes"
        return ""
    except BROKEN as error:
        # such as a link to itself
        return f"what HDF5 cannot open ({reason(error)})"


def _bytes_of(shape: tuple[int, ...], itemsize: int) -> int:
    """Bytes of an array, exact for shapes that only a forged file announces."""
    for length in shape:
        itemsize *= length
    return itemsize
