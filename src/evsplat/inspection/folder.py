"""Folders of drawings below ``inspect/``: one for each capture or recording, whatever its name."""

import os
from pathlib import Path

from evsplat.errors import DataError
from evsplat.files import write_json
from evsplat.untrusted.text import read_json

_NOTE = "inspected.json"
"""File beside the drawings that says what they show."""


def note_inspected(path: Path, folder: Path) -> None:
    """Write down in a ``folder`` of drawings that they are of the capture or recording ``path``."""
    write_json(folder / _NOTE, {"path": str(path.resolve())})


def default_folder(path: Path) -> Path:
    """``inspect/NAME``, or ``inspect/NAME-2`` and so on where that shows another one than ``path``.

    A folder that does not say what it shows is left alone, unless it is empty.
    """
    first = Path("inspect") / Path(os.path.abspath(path)).name  # of a link, its own
    folder, number = first, 1
    while not _is_free(folder, path):
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def _is_free(folder: Path, path: Path) -> bool:
    if not folder.is_dir():
        return not folder.exists()
    if not (folder / _NOTE).exists():
        return not any(folder.iterdir())
    try:
        note = read_json(folder / _NOTE)
    except DataError:
        return False
    return isinstance(note, dict) and note.get("path") == str(path.resolve())
