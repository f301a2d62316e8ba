"""Text tables (.txt, .csv, gzipped too) with named, positional or recognisable columns."""

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import (
    ByteReader,
    Damage,
    RawEvents,
    ReadOptions,
    Source,
)
from evsplat.events.formats.columns import match_names
from evsplat.events.formats.table import NO_POLARITY, Table, table_order

_READ_BYTES = 4 << 20
_MAX_LINE_BYTES = 4096
_MAX_HEADER_LINES = 100
_SAMPLE_LINES = 2000
# CeleX-V of the MMHPSD data set: 800 x 1280 pixels, counted from the opposite corner
_MMHPSD_COLUMNS = ("y", "x", "t", "-", "p")
_MMHPSD_SIZE = (800, 1280)
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_PASSED_OVER = "-"


@dataclass
class _Layout:
    delimiter: str | None
    """None: any white space."""
    count: int
    """Fields per line."""
    first_byte: int
    """Where the events begin."""
    names: list[str]
    """Of the columns, where the file has them."""
    width: int | None = None
    height: int | None = None


class Text(Source):
    """A text file with one event per line."""

    def __init__(self, path: Path, options: ReadOptions, damage: Damage) -> None:
        self._path = path
        self._damage = damage
        self.notes: list[str] = []
        self._layout = _read_layout(path)
        self.width, self.height = self._layout.width, self._layout.height
        sample = self._sample()
        self._mmhpsd = options.columns == ("mmhpsd",)
        self._columns = self._find_columns(sample, options)
        if self._mmhpsd:
            self.width, self.height = _MMHPSD_SIZE
        head = Table(path, self._named(sample), options.time_unit)
        self._unit = head.unit
        self.notes += head.notes
        self.has_polarity = head.has_polarity or self._any_polarity()
        if self.has_polarity and NO_POLARITY in self.notes:
            self.notes.remove(NO_POLARITY)

    def blocks(self) -> Iterator[RawEvents]:
        """A few megabytes of text at a time."""
        first = 0
        for rows in self._tables():
            events = Table(self._path, self._named(rows), self._unit).events(slice(None), first)
            yield self._turned(events) if self._mmhpsd else events
            first += len(rows)

    def _find_columns(self, sample: np.ndarray, options: ReadOptions) -> dict[str, int]:
        """Component -> index of its column."""
        count = self._layout.count
        given = options.columns
        if given is None and self._layout.names:
            named = match_names(self._layout.names)
            if not {"t", "x", "y"} <= set(named):
                raise DataError(
                    f"{self._path}: its columns are named {', '.join(self._layout.names)}; say "
                    "which are t, x, y and p with columns."
                )
            return {key: self._layout.names.index(name) for key, name in named.items()}
        if given is None and count == len(_MMHPSD_COLUMNS):
            self.notes.append("five columns without names: read as MMHPSD's v, u, t, -, polarity")
            self._mmhpsd = True
        if self._mmhpsd:
            given = _MMHPSD_COLUMNS
        if given is None:
            given = tuple(table_order(self._path, sample, options))
        if not isinstance(given, tuple) or len(given) != count:
            raise DataError(
                f"{self._path}: has {count} columns, columns names {len(given)} ({given}); give "
                "one name per column, '-' to pass over one."
            )
        columns = {name: index for index, name in enumerate(given) if name != _PASSED_OVER}
        if not {"t", "x", "y"} <= set(columns) <= set("txyp"):
            raise DataError(
                f"{self._path}: columns is {','.join(given)}, expected t, x, y and perhaps p, "
                "each once, and '-' for what to pass over."
            )
        return columns

    def _named(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        return {name: rows[:, index] for name, index in self._columns.items()}

    def _any_polarity(self) -> bool:
        """Whether an event anywhere has a polarity other than 0; reads until the first."""
        if "p" not in self._columns:
            return False
        column = self._columns["p"]
        return any(rows[:, column].any() for rows in self._tables())

    def _turned(self, events: RawEvents) -> RawEvents:
        width, height = _MMHPSD_SIZE
        return events._replace(x=width - 1 - events.x, y=height - 1 - events.y)

    def _sample(self) -> np.ndarray:
        with ByteReader(self._path) as reader:
            reader.skip_to(self._layout.first_byte)
            lines = [reader.read_line(_MAX_LINE_BYTES) for _ in range(_SAMPLE_LINES)]
        # the last line may be cut
        return self._parse(b"".join(line for line in lines if line.endswith(b"\n")), 0)

    def _tables(self) -> Iterator[np.ndarray]:
        """Rows of numbers, (N, columns) float64, a few megabytes of text at a time."""
        with ByteReader(self._path) as reader:
            reader.skip_to(self._layout.first_byte)
            rest, first = b"", 0
            while data := reader.read(_READ_BYTES):
                cut = data.rfind(b"\n") + 1
                if cut or len(rest) > _MAX_LINE_BYTES:
                    rows = self._parse(rest + data[:cut], first)
                    first += len(rows)
                    if len(rows):
                        yield rows
                    rest = b""
                rest += data[cut:]
            if rest.strip():
                rows = self._parse(rest, first)
                yield rows

    def _parse(self, text: bytes, first: int) -> np.ndarray:
        if not text.strip():
            return np.zeros((0, self._layout.count))
        try:
            rows = np.loadtxt(
                io.BytesIO(text), delimiter=self._layout.delimiter, ndmin=2, dtype=np.float64
            )
        except ValueError as error:
            raise DataError(f"{self._path}: near event {first}: {error}.") from None
        if rows.shape[1] != self._layout.count:
            raise DataError(f"{self._path}: near event {first}: {rows.shape[1]} columns.")
        return rows


def _read_layout(path: Path) -> _Layout:
    """Pass over comments and the header; the first line of numbers tells the fields."""
    names: list[str] = []
    size: list[int | None] = [None, None]
    with ByteReader(path) as reader:
        for _ in range(_MAX_HEADER_LINES):
            start = reader.offset
            raw = reader.read_line(_MAX_LINE_BYTES)
            if not raw:
                raise DataError(f"{path}: holds no events.")
            line = raw.strip().removeprefix(b"\xef\xbb\xbf")
            delimiter = next((d for d in (b",", b";", b"\t") if d in line), None)
            fields = [field.strip() for field in line.lstrip(b"#% ").split(delimiter)]
            if not fields or not fields[0]:
                continue
            if line[:1] in b"#%" or not all(_NUMBER.fullmatch(field) for field in fields):
                if not all(re.fullmatch(rb"[\w@ .()\[\]-]+", field) for field in fields):
                    raise DataError(
                        f"{path}: line {raw[:60]!r} at byte {start} is neither numbers nor the "
                        "names of columns; not a recording that evsplat reads."
                    )
                if len(fields) >= 3:
                    names, size = _read_names([field.decode() for field in fields])
                continue
            if len(fields) == 2 and size == [None, None]:
                # the first line of E2VID's text files is the size of the sensor
                size = [int(float(field)) for field in fields]
                continue
            return _Layout(
                delimiter.decode() if delimiter and delimiter != b"\t" else None,
                len(fields),
                start,
                names if len(names) == len(fields) else [],
                *size,
            )
    raise DataError(f"{path}: no line of numbers among its first {_MAX_HEADER_LINES}.")


def _read_names(fields: list[str]) -> tuple[list[str], list[int | None]]:
    """Names, and the sizes that ``x@320`` and ``y@240`` tell."""
    names: list[str] = []
    size: dict[str, int | None] = {"x": None, "y": None}
    for field in fields:
        name, _, tail = field.partition("@")
        names.append(name.strip())
        if tail.isdigit() and name.strip() in size:
            size[name.strip()] = int(tail)
    return names, [size["x"], size["y"]]
