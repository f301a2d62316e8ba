"""What keeps a file from being read, in one sentence."""

import io
import lzma
import os
import pickle
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evsplat.errors import DataError, EvsplatError

BROKEN = (
    *(OSError, EOFError, ValueError, TypeError, KeyError, AttributeError, IndexError),
    *(AssertionError, OverflowError, MemoryError, RuntimeError, struct.error, zlib.error),
    *(lzma.LZMAError, pickle.UnpicklingError, zipfile.BadZipFile),
    *(SyntaxError, tokenize.TokenError),
)
"""What the libraries that parse files raise on damaged ones."""
MISFITS = (
    KeyError,
    TypeError,
    IndexError,
    AttributeError,
    ValueError,
    RuntimeError,
    ArithmeticError,
)
"""What comes of a record with other values than those that were written into it."""
_LONGEST = 80
"""Letters of a value that fit a message."""
_MOST_LETTERS = 200


def ordinary_file(path: Path | str, *, error: type[EvsplatError] = DataError) -> int:
    """Size in bytes of a file that can be opened; anything else is an ``error``.

    Devices and pipes are refused, which might never end.
    """
    try:
        found = os.stat(path)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError
        if not os.access(path, os.R_OK):
            raise PermissionError
    except (OSError, ValueError) as fault:
        raise error(f"{path}: {why_not_read(fault)}.") from None
    if not stat.S_ISREG(found.st_mode):
        raise error(f"{path}: a device or pipe, expected a file; copy what it gives into a file.")
    return found.st_size


def open_bytes(
    path: Path | str, *, error: type[EvsplatError] = DataError, buffer: int = io.DEFAULT_BUFFER_SIZE
) -> io.BufferedReader:
    """A file opened to be read, ``buffer`` bytes at a time; an ``error`` as of `ordinary_file`."""
    ordinary_file(path, error=error)
    return io.BufferedReader(io.FileIO(path), buffer)


def open_text(path: Path | str, *, newline: str | None = None) -> io.TextIOWrapper:
    """A text in UTF-8 opened to be read; a `DataError` where `ordinary_file` refuses it."""
    ordinary_file(path)
    return open(path, encoding="utf-8-sig", newline=newline)


def why_not_read(error: OSError | ValueError) -> str:
    """What keeps a file from being opened and what to do, in words that follow its path."""
    match error:
        case FileNotFoundError() | NotADirectoryError():
            return "file not found"
        case IsADirectoryError():
            return "a folder, expected a file; correct the path"
        case PermissionError():
            return "may not be read; give yourself the permission to read it"
        case OSError():
            return f"cannot be read ({error.strerror or error}); copy it again"
        case _:
            return f"cannot be a path ({error}); correct it"


@contextmanager
def broken_as(
    path: Path | str,
    fault: str,
    remedy: str = "",
    *,
    kinds: tuple[type[BaseException], ...] = BROKEN,
) -> Iterator[None]:
    """Errors of ``kinds`` in the block as a `DataError` that begins with path and fault."""
    try:
        yield
    except kinds as cause:
        advice = f"; {remedy}" if remedy else ""
        raise DataError(f"{path}: {fault} ({reason(cause)}){advice}.") from cause


def reason(error: BaseException) -> str:
    """What an error of a library says, on one line and without advice to programmers."""
    text = str(error).partition("; use sys.set_int_max_str_digits")[0]
    return " ".join(text.split())[:_MOST_LETTERS] or type(error).__name__


def brief(value: Any) -> str:
    """``repr`` cut to a length that fits a message."""
    try:
        text = repr(value)
    except RecursionError:
        text = f"a {type(value).__name__} nested too deeply to be shown"
    except ValueError:
        text = "an integer of thousands of digits"
    return shortened(text, _LONGEST)


def shortened(text: str, most: int) -> str:
    """A text of ``most`` letters at most, which ends with "…" where it was cut."""
    return text if len(text) <= most else text[: most - 1] + "…"
