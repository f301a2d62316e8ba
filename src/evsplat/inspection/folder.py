"""Folders of drawings below ``inspect/``: one for each capture or recording, whatever its name."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from evsplat.errors import DataError
from evsplat.files import held_folder, write_json
from evsplat.untrusted.text import read_json

_NOTE = "inspected.json"
"""File beside the drawings that says what they show."""
_SIGN = ".inspecting"
"""File that is there while something is drawn into the folder, and whose lock is held then."""


def note_inspected(path: Path, folder: Path) -> None:
    """Write down in a ``folder`` of drawings that they are of the capture or recording ``path``."""
    write_json(folder / _NOTE, {"path": str(path.resolve())})


@contextmanager
def default_folder(path: Path) -> Iterator[Path]:
    """``inspect/NAME``, or ``inspect/NAME-2`` and so on where that shows another one than ``path``.

    A folder that does not say what it shows is left alone, unless it is empty. It is held to the
    end of the block: where another process draws into it this one waits to see what. One that was
    made and has nothing in it goes at the end.
    """
    first = Path("inspect") / Path(os.path.abspath(path)).name  # of a link, its own
    busy = "draws into this folder; this one goes on when it is done."
    for number in count(1):
        folder = first if number == 1 else first.with_name(f"{first.name}-{number}")
        if _is_free(folder, path):
            with held_folder(folder, _SIGN, busy, wait=True):
                if _is_free(folder, path):  # nobody drew another one while this one waited
                    yield folder
                    return


def _is_free(folder: Path, path: Path) -> bool:
    if not folder.is_dir():
        return not folder.exists()
    if not (folder / _NOTE).exists():
        return all(file.name == _SIGN for file in folder.iterdir())
    try:
        note = read_json(folder / _NOTE)
    except DataError:
        return False
    return isinstance(note, dict) and note.get("path") == str(path.resolve())
