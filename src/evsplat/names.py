"""The one rule for names that other people's files give: any of them may become a file's name."""

import os
import re
import unicodedata
import zlib
from itertools import accumulate
from pathlib import Path, PurePath

from evsplat.errors import DataError

NAME_RULE = "1 to 200 bytes of UTF-8 without '/', '\\' and control characters, and not '.' or '..'"
_MOST_BYTES = 200
"""File systems take 255; the rest is for what is put around a name."""
# Control characters, and those that end a line or a paragraph.
_CONTROL = ("Cc", "Zl", "Zp")


def is_name(text: str) -> bool:
    """Whether a text obeys `NAME_RULE`: a file of that name lies in the folder it is put into."""
    try:
        size = len(text.encode())
    except UnicodeEncodeError:
        # JSON can write half of a surrogate pair, which is no character
        return False
    return (
        0 < size <= _MOST_BYTES
        and text not in (".", "..")
        and not any(c in "/\\" or unicodedata.category(c) in _CONTROL for c in text)
    )


def checked_name(text: str, what: str) -> str:
    """``text``; a `DataError` where it is no name for ``what``, such as "a frame"."""
    if not is_name(text):
        raise DataError(f"{text[:80]!r} is no name for {what}, expected {NAME_RULE}; rename it.")
    return text


def natural_order(name: str) -> list[tuple[int, str]]:
    """Key by which frame9 comes before frame10."""
    parts = re.findall(r"\d{1,300}|\D+", name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def is_path_of_names(text: str) -> bool:
    """Whether a text is a relative path whose parts are names, so that it never goes up."""
    parts = PurePath(text).parts
    return bool(parts) and all(map(is_name, parts))


def leads_out(path: Path, folder: Path) -> bool:
    """Whether ``path``, all links in it followed, lies elsewhere than below ``folder``."""
    names = path.relative_to(folder).parts
    places = list(accumulate(names, os.path.join, initial=str(folder)))[1:]
    if places and ".." not in names and not any(map(os.path.islink, places)):
        return False  # asked of every file of a capture: hardly any has a link to follow
    inside = os.path.join(os.path.realpath(folder), "")
    return not os.path.realpath(path).startswith(inside)


def file_stem(*parts: str) -> str:
    """Names joined with "_", reduced to letters, digits, dot, dash and underscore.

    A name that loses something gets a checksum, so that two such names stay apart.
    """
    stems = []
    for part in parts:
        safe = re.sub(r"[^A-Za-z0-9._-]+", "-", part)
        stems.append(safe if safe == part else f"{safe}-{zlib.crc32(part.encode()):08x}")
    return "_".join(stems)
