"""Text tables (.txt, .csv, gzipped too) with named, positional or recognisable columns."""

from collections.abc import Iterator

import numpy as np

from evsplat.compiled import native_for
from evsplat.errors import DataError
from evsplat.events.formats.base import (
    SAY_COLUMNS,
    ByteReader,
    RawEvents,
    Source,
    is_gzipped,
    two_recordings,
)
from evsplat.events.formats.table import (
    NO_POLARITY,
    assumed_order,
    assumed_unit,
    guess_time_unit,
    match_names,
    names_pixels,
    table_order,
    to_polarity,
)
from evsplat.events.formats.text_layout import MAX_LINE_BYTES, inspect_text
from evsplat.options import ReadOptions

_READ_BYTES = 1 << 22
_MIN_LINE_BYTES = 6
_COMPONENTS = "txyp"
_TIME_EXPONENTS = {"s": 6, "ms": 3, "us": 0, "ns": -3}
# CeleX-V of the MMHPSD data set: 800 x 1280 pixels, counted from the opposite corner
_MMHPSD_COLUMNS = ("y", "x", "t", "-", "p")
_MMHPSD_SIZE = (800, 1280)
_PASSED_OVER = "-"
# TextError in native/event_text.h
_ERRORS = (
    "",
    "has another number of fields",
    "is not made of numbers",
    "has a fraction where a whole number is expected",
    "has a number that does not fit in 64 bits",
)


class Text(Source):
    """A text file with one event per line."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        self._native = native_for(f"{self.path}: reading text")
        self._file = file = inspect_text(self.path)
        self.width, self.height = file.width, file.height
        self._mmhpsd = options.columns == ("mmhpsd",)
        columns = self._find_columns(options)
        if self._mmhpsd:
            self.width, self.height = _MMHPSD_SIZE
            given = (options.width or self.width, options.height or self.height)
            if given != _MMHPSD_SIZE:
                raise DataError(
                    f"{self.path}: MMHPSD's five columns are of a sensor of 800x1280 pixels, found "
                    f"{given[0]}x{given[1]} given; leave out --width and --height, or name the "
                    "columns of another recording with --columns."
                )
        self._roles = [_COMPONENTS.find(name) if name else -1 for name in columns]
        self._unit = options.time_unit or self._find_unit(columns.index("t"))
        # as `CsvWriter` has it: in a column called "on" 0 is darker
        called_on = ("on", "p") in zip(file.names, columns, strict=False)
        self.has_polarity = "p" in columns and (called_on or self._any_polarity())
        if not self.has_polarity and len(file.sample):
            self.notes.append(NO_POLARITY)

    def blocks(self) -> Iterator[RawEvents]:
        """A few megabytes of text at a time."""
        first = 0
        for t, x, y, p in self._parsed():
            p = to_polarity(p, str(self.path), first)
            if self._mmhpsd:
                x, y = _MMHPSD_SIZE[0] - 1 - x, _MMHPSD_SIZE[1] - 1 - y
            yield RawEvents(t, x, y, p)
            first += len(t)

    def _find_columns(self, options: ReadOptions) -> list[str]:
        """Component of each column, or "" to pass over it."""
        file, given = self._file, options.columns
        if given is None and file.names:
            if not names_pixels(file.names):
                raise DataError(
                    f"{self.path}: its columns are named {', '.join(file.names)}; say which are "
                    f"t, x, y and p with {SAY_COLUMNS}."
                )
            component = {name: key for key, name in match_names(file.names).items()}
            return [component.get(name, "") for name in file.names]
        if given is None and file.fields == len(_MMHPSD_COLUMNS) and not file.names:
            self.notes.append(
                "five columns without names are read as MMHPSD's v, u, in-pixel time, off-pixel "
                "time, polarity"
            )
            self._mmhpsd = True
        if self._mmhpsd:
            given = _MMHPSD_COLUMNS
        if given is None:
            given = tuple(table_order(self.path, file.sample, options))
            self.notes.append(assumed_order(given))
        if not isinstance(given, tuple) or len(given) != file.fields:
            raise DataError(
                f"{self.path}: has {file.fields} columns and --columns names {len(given)}; give "
                "one name per column, '-' to pass over one."
            )
        columns = [name for name in given if name != _PASSED_OVER]
        if not {"t", "x", "y"} <= set(columns) <= set(_COMPONENTS) or len(set(columns)) < len(
            columns
        ):
            raise DataError(
                f"{self.path}: --columns is {','.join(given)}, expected t, x, y and perhaps p, "
                "each once, and '-' for what to pass over."
            )
        return ["" if name == _PASSED_OVER else name for name in given]

    def _find_unit(self, column: int) -> str:
        """The time unit, guessed from the times of the first lines."""
        times = self._file.sample[:, column]
        whole = not len(times) or self._file.whole_times[column]
        unit = guess_time_unit(times.astype(np.int64) if whole else times)
        if unit != "us":
            self.notes.append(assumed_unit(unit))
        return unit

    def _any_polarity(self) -> bool:
        """True where an event has a polarity other than 0; reads until the first such."""
        return not len(self._file.sample) or any(p.any() for _, _, _, p in self._parsed())

    def _parsed(self) -> Iterator[np.ndarray]:
        """Components (4, N) int64, times in microseconds, of a few megabytes of text at a time."""
        with ByteReader(self.path, self._file.first_byte) as reader:
            rest, first, last = b"", 0, False
            while not last:
                data = reader.read(_READ_BYTES)
                last = not data
                text = rest + data if rest else data
                start = reader.offset - len(text)
                if not last and b"\n" not in data and len(text) > MAX_LINE_BYTES:
                    raise DataError(
                        f"{self.path}: the line at byte {start} is longer than "
                        f"{MAX_LINE_BYTES} bytes; not a line of numbers."
                    )
                columns, taken = self._parse(text, start, first, last)
                rest = text[taken:]
                first += columns.shape[1]
                if columns.shape[1]:
                    yield columns

    def _parse(self, text: bytes, start: int, first: int, last: bool) -> tuple[np.ndarray, int]:
        """Columns of the whole lines, and the bytes taken."""
        columns = np.empty((len(_COMPONENTS), len(text) // _MIN_LINE_BYTES + 2), dtype=np.int64)
        if "p" not in [_COMPONENTS[role] for role in self._roles if role >= 0]:
            columns[3] = 0
        rows, taken, error, field = self._native.parse_events(
            np.frombuffer(text, dtype=np.uint8),
            last,
            self._roles,
            self._file.delimiter,
            _TIME_EXPONENTS[self._unit],
            columns,
        )
        if error:
            found = text[taken:].split(b"\n", 1)[0]
            if found.strip() in self._file.header:
                raise two_recordings(self.path, start + taken, zipped=is_gzipped(self.path))
            line = found[:60].decode("latin-1")
            what = (
                f"the line of event {first + rows} at byte {start + taken} {_ERRORS[error]} "
                f"(field {field + 1} of {self._file.fields}: {line!r})"
            )
            at_end = text.find(b"\n", taken) < 0 and last
            if not at_end:
                raise DataError(f"{self.path}: {what}.")
            self.damage.found(what, repaired_by="leaves out a last line that was cut")
            taken = len(text)
        return columns[:, :rows], taken
