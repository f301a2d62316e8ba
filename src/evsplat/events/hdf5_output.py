"""A file that HDF5 writes into without ever seeing an error of the disk."""

import io
from collections.abc import Callable
from pathlib import Path

import h5py

from evsplat.files import open_output

_ONLY_DARKER = "only_darker"
"""Attribute of a recording in which every event is darker, as its polarities look like none."""


def note_only_darker(file: h5py.File) -> None:
    """Write down that the recording has polarities, all of which are 0."""
    file.attrs[_ONLY_DARKER] = True


def has_only_darker(file: h5py.File) -> bool:
    """Whether polarities that are 0 throughout mean darker; else there are none."""
    return bool(file.attrs.get(_ONLY_DARKER, False))


class Hdf5Output(io.RawIOBase):
    """What h5py writes goes to a file; where that fails, the error is kept and memory takes it.

    HDF5 crashes the process when it cannot flush a file that it closes. Here all that it writes
    arrives, and can be read again, until whoever writes the recording asks for the `error`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = open_output(path, "w+b", buffered=False)
        self._place = self._size = 0
        self._held: list[tuple[int, bytes]] = []
        """Places and bytes that the disk did not take, in the order in which they came."""
        self.error: OSError | None = None
        """The first error of the disk."""

    def raise_error(self) -> None:
        """Raise what went wrong, if anything did."""
        if self.error is not None:
            raise self.error

    def readable(self) -> bool:
        """It is."""
        return True

    def writable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """Place in the file."""
        return self._place

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Go to a place from the start, from here or from the end."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence]
        self._place = base + offset
        return self._place

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size."""
        self._size = self._place if size is None else size
        if self.error is None:
            self._noting(lambda: self._file.truncate(self._size))
        return self._size

    def write(self, data: bytes | bytearray | memoryview, /) -> int:  # type: ignore[override]
        """Take all bytes, whatever the disk says."""
        content = bytes(data)
        if self.error is None:
            self._noting(lambda: self._put(content))
        if self.error is not None:
            self._held.append((self._place, content))
        self._place += len(content)
        self._size = max(self._size, self._place)
        return len(content)

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override]
        """Read what was written."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._place))
        self._file.seek(self._place)
        found = self._file.read(count)
        view[:count] = found + bytes(count - len(found))
        for start, content in self._held:
            first, last = max(start, self._place), min(start + len(content), self._place + count)
            if first < last:
                view[first - self._place : last - self._place] = content[
                    first - start : last - start
                ]
        self._place += count
        return count

    def close(self) -> None:
        """Close the file; call it after h5py has closed its own."""
        if not self.closed:
            self._noting(self._file.close)
        super().close()

    def _put(self, content: bytes) -> None:
        """Write, at once or, near the end of the disk, piece by piece."""
        self._file.seek(self._place)
        rest = memoryview(content)
        while rest:
            rest = rest[self._file.write(rest) :]

    def _noting(self, act: Callable[[], object]) -> None:
        try:
            act()
        except OSError as error:
            self.error = self.error or error
