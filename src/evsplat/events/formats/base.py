"""Parts that readers of recordings share: options, raw blocks, bytes with an offset, damage."""

import gzip
import os
import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.options import ReadOptions
from evsplat.untrusted.faults import open_bytes

SAY_COLUMNS = "--columns of 'evsplat convert'"
SAY_UNIT = "--time-unit of 'evsplat convert'"
"""How a user says what a table does not, in the words of the verb that takes it."""
BLOCK_EVENTS = 1 << 18
"""Events that a reader hands over at a time, about; bounds the memory of a pass."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BUFFER_BYTES = 1 << 16
_SEEK_BYTES = 1 << 12
# Kept of what was read, to know the beginning of another recording with all lines of its header.
_SEEN_BYTES = 1 << 10
# No line of a header begins twice: the last event of the first recording may end in these bytes.
_LINES_BEFORE = re.compile(rb"(?:% (?!% )[ -~]*\r?\n)*\Z")


class RawEvents(NamedTuple):
    """Events as a file says them, one array of length N per component; not yet checked."""

    t: np.ndarray
    """Microseconds, integer."""
    x: np.ndarray
    y: np.ndarray
    """Column and row, integer, 0 at the left and the top."""
    p: np.ndarray
    """Polarity: positive is brighter."""


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A picture that was recorded beside the events."""

    image: np.ndarray
    """(H, W) grey or (H, W, 3) RGB, uint8."""
    exposure_us: tuple[int, int]
    """Start and end of the exposure on the clock of the events."""


@dataclass
class Damage:
    """Faults of a recording: an error by default, a counted repair where asked for."""

    path: Path
    repair: bool
    counts: dict[str, int] = field(default_factory=dict)
    details: dict[str, str] = field(default_factory=dict)
    """Of a kind of repair, how bad it was where it was worst."""
    warnings: dict[str, str] = field(default_factory=dict)
    """Of a kind of repair, why what it makes may be wrong; or of what needs none, what is odd."""

    def begin(self) -> None:
        """Forget what was found: the file is read anew."""
        for found in (self.counts, self.details, self.warnings):
            found.clear()

    def found(self, what: str, *, repaired_by: str, count: int = 1) -> None:
        """Raise `DataError` that says ``what``, or count it under ``repaired_by``."""
        if not self.repair:
            raise DataError(f"{self.path}: {what}; repair=True (--repair) {repaired_by}.")
        self.counts[repaired_by] = self.counts.get(repaired_by, 0) + count

    def notes(self) -> list[str]:
        """One line per kind of repair done so far, and one more where it may have done harm."""
        lines = []
        for what, count in self.counts.items():
            detail = f", {self.details[what]}" if what in self.details else ""
            lines.append(f"repaired: {what} ({count:,}){detail}")
        return lines + [f"warning: {why}" for why in self.warnings.values()]


class Source(ABC):
    """An opened recording of one format: its header is read, its events are read on demand."""

    width: int | None = None
    height: int | None = None
    has_polarity: bool = True

    def __init__(self, path: Path, options: ReadOptions, damage: Damage) -> None:
        self.path = path
        self.damage = damage
        self.notes: list[str] = []
        self.read_header(options)

    @abstractmethod
    def read_header(self, options: ReadOptions) -> None:
        """Read all but the events."""

    @abstractmethod
    def blocks(self) -> Iterator[RawEvents]:
        """Events from the first to the last, in order of the file."""

    def frames(self) -> Iterator[RecordedFrame]:
        """Pictures recorded beside the events; none in most formats."""
        return iter(())


class ByteReader(ExitStack):
    """Sequential bytes of a file, gunzipped where it is a gzip file, with the offset in mind."""

    def __init__(
        self, path: Path, start: int = 0, *, another: re.Pattern[bytes] | None = None
    ) -> None:
        """The first byte to be read is that at ``start``.

        Where ``another`` matches what is read with `read`, another recording begins, as in files
        that were put together: a `DataError`, since its header would be read as events.
        """
        super().__init__()
        self.path = path
        self.offset = 0
        self._another: re.Pattern[bytes] | None = None
        self._seen = b""
        self._file = self.enter_context(open_bytes(path, buffer=_BUFFER_BYTES))
        self._size = os.fstat(self._file.fileno()).st_size
        self.zipped = self._file.read(2) == b"\x1f\x8b"
        self._file.seek(0)
        self._stream = gzip.GzipFile(fileobj=self._file) if self.zipped else self._file
        self.skip_to(start)
        self._another = another  # from here on: what was skipped has a header of its own

    def read(self, count: int) -> bytes:
        """``count`` bytes, fewer only at the end of the file."""
        data = self._taken(self._stream.read, count)
        if self._another is not None:
            self._refuse_another(self._another, data)
        return data

    def read_line(self, limit: int) -> bytes:
        """Bytes up to and with the next newline, at most ``limit``."""
        return self._taken(self._stream.readline, limit)

    def skip_to(self, offset: int) -> None:
        """Go on to ``offset`` or the end of the file."""
        if not self.zipped and offset - self.offset > _SEEK_BYTES:
            self.offset = self._file.seek(min(offset, self._size))
        while self.offset < offset and self.read(min(offset - self.offset, 1 << 20)):
            pass

    def records(self, kind: np.dtype, most: int, damage: Damage) -> Iterator[np.ndarray]:
        """Events of a fixed size to the end of the file, at most ``most`` at a time."""
        while data := self.read(most * kind.itemsize):
            whole = len(data) // kind.itemsize * kind.itemsize
            yield np.frombuffer(data[:whole] if whole < len(data) else data, kind)
            if whole < len(data):
                damage.found(
                    f"ends in the middle of an event at byte {self.offset}",
                    repaired_by="keeps the events before the cut",
                )

    def _refuse_another(self, another: re.Pattern[bytes], data: bytes) -> None:
        """Raise where another recording begins in ``data`` or across its beginning."""
        seen = self._seen + data
        found = another.search(seen)
        if found:
            before = _LINES_BEFORE.search(seen, max(0, found.start() - _SEEN_BYTES), found.start())
            first = before.start() if before else found.start()
            raise two_recordings(self.path, self.offset - len(seen) + first, zipped=self.zipped)
        self._seen = seen[-_SEEN_BYTES:]

    def _taken(self, read: Callable[[int], bytes], most: int) -> bytes:
        try:
            data = read(most)
        except (OSError, EOFError, zlib.error) as error:
            raise DataError(
                f"{self.path}: cannot be read after byte {self.offset} ({error}); copy it again."
            ) from None
        self.offset += len(data)
        return data


def parts_said(path: Path, event: int) -> str:
    """How the user takes the recording before an event of a file, or that from it on."""
    first = command("convert", path, "PART.h5", "--stop", str(event))
    said = f"'{first}' keeps the one before, --skip {event} the other"
    if path.suffix.startswith(".aedat"):  # whose pictures convert leaves out
        said += " (so does 'evsplat import davis', with --frames for its pictures)"
    return said


def two_recordings(path: Path, at: int, *, zipped: bool) -> DataError:
    """The error of a file in which another recording begins at byte ``at``."""
    unpack = "gunzip it and " if zipped else ""
    return DataError(
        f"{path}: another recording begins at byte {at}, expected one in a file; {unpack}cut it "
        f"there (head -c {at} IN > FIRST; tail -c +{at + 1} IN > SECOND) and give the part that "
        "belongs to the pictures."
    )


def is_gzipped(path: Path) -> bool:
    """True for a gzip file, whatever its name."""
    with ByteReader(path) as reader:
        return reader.zipped


def peek(path: Path, count: int) -> bytes:
    """The first bytes, gunzipped where the file is a gzip file."""
    with ByteReader(path) as reader:
        return reader.read(count)
