"""Layout of a text file of events: its header, its delimiter, the names of its columns."""

import math
import re
from codecs import BOM_UTF8
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import ByteReader
from evsplat.events.formats.table import names_pixels

MAX_LINE_BYTES = 4096
_MAX_HEADER_LINES = 100
_SAMPLE_LINES = 2000
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
# empty: that of the numbers of rows, as pandas writes them
_NAME = re.compile(rb"[\w@ .()\[\]/-]*")
_DELIMITERS = (b",", b";")


@dataclass(frozen=True)
class TextFile:
    """Layout and first lines of a text file."""

    delimiter: str
    """Separator of fields; empty: any white space."""
    fields: int
    """Fields per line."""
    first_byte: int
    """Offset of the first event."""
    names: list[str]
    """Names of the columns; empty where the file does not say."""
    width: int | None
    height: int | None
    sample: np.ndarray
    """The first lines, (N, fields) float64."""
    whole_times: list[bool]
    """Per field, whether all of the sample is written without a fraction."""
    header: tuple[bytes, ...]
    """Lines before the first event, without blanks around them."""


def inspect_text(path: Path) -> TextFile:
    """Pass over comments and header; the first line of numbers has the delimiter and the fields.

    A file with a header that names columns and no line after it is an empty recording.
    """
    names: list[str] = []
    header: list[bytes] = []
    size: tuple[int | None, int | None] = (None, None)
    with ByteReader(path) as reader:
        for _ in range(_MAX_HEADER_LINES):
            start = reader.offset
            raw = reader.read_line(MAX_LINE_BYTES)
            if not raw:
                if names:
                    empty = np.zeros((0, len(names)))
                    return TextFile("", len(names), start, names, *size, empty, [], ())
                raise DataError(f"{path}: holds no events.")
            if start == 0 and raw.startswith(BOM_UTF8):  # as Windows begins a text
                raw, start = raw[len(BOM_UTF8) :], len(BOM_UTF8)
            line = raw.strip()
            delimiter = next((d for d in _DELIMITERS if d in line), b"")
            fields = _split(line.lstrip(b"#% "), delimiter)
            if not any(fields):
                continue
            is_comment = line[:1] in (b"#", b"%")
            header.append(line)
            if is_comment or not all(_NUMBER.fullmatch(field) for field in fields):
                if not is_comment and not all(_NAME.fullmatch(field) for field in fields):
                    raise DataError(
                        f"{path}: line {raw[:60]!r} at byte {start} is neither numbers nor names "
                        "of columns; not a recording that evsplat reads. Expected an event in each "
                        "line: numbers with a decimal point, between commas, semicolons or blanks."
                    )
                # what is remarked below the names of the columns names none
                if len(fields) >= 3 and not (is_comment and names_pixels(names)):
                    names, size = _read_names([field.decode("latin-1") for field in fields])
                continue
            if len(fields) == 2 and size == (None, None):
                # the first line of E2VID's text files is the size of the sensor
                size = _read_size(path, fields)
                continue
            lines = [raw] + [reader.read_line(MAX_LINE_BYTES) for _ in range(_SAMPLE_LINES)]
            sample, whole = _read_sample(lines, delimiter, len(fields))
            return TextFile(
                delimiter.decode(),
                len(fields),
                start,
                names if len(names) == len(fields) else [],
                *size,
                sample,
                whole,
                tuple(header[:-1]),
            )
    raise DataError(
        f"{path}: no line of numbers among its first {_MAX_HEADER_LINES} (the last is "
        f"{raw[:60]!r}); expected an event in each line, with polarity 0 and 1, or -1 and 1."
    )


def _split(line: bytes, delimiter: bytes) -> list[bytes]:
    return [field.strip() for field in line.split(delimiter or None)]


def _read_sample(lines: list[bytes], delimiter: bytes, count: int) -> tuple[np.ndarray, list[bool]]:
    """Numbers of the first lines, up to the first that is not made of them (the parser says so)."""
    rows: list[list[float]] = []
    whole = [True] * count
    for line in lines:
        fields = _split(line, delimiter)
        if len(fields) != count or not all(_NUMBER.fullmatch(field) for field in fields):
            break
        rows.append([float(field) for field in fields])
        for column, field in enumerate(fields):
            whole[column] &= field.lstrip(b"+-").isdigit()
    return np.array(rows, dtype=np.float64).reshape(-1, count), whole


def _read_size(path: Path, fields: list[bytes]) -> tuple[int, int]:
    width, height = (float(field) for field in fields)
    if not (math.isfinite(width) and math.isfinite(height)):
        line = b" ".join(fields)[:60].decode("latin-1")
        raise DataError(
            f"{path}: its first line is {line!r}, expected width and height of the sensor in "
            "pixels, or an event; correct the line."
        )
    return int(width), int(height)


def _read_names(fields: list[str]) -> tuple[list[str], tuple[int | None, int | None]]:
    """Names, and the size of the sensor that ``x@320`` and ``y@240`` give."""
    names: list[str] = []
    size: dict[str, int] = {}
    for field in fields:
        name, _, tail = field.partition("@")
        names.append(name.strip())
        if tail.isdecimal():
            size[name.strip()] = int(tail)
    return names, (size.get("x"), size.get("y"))
