"""Commands that messages give the user to type."""

import shlex
import sys
from pathlib import Path


def command(*words: Path | str) -> str:
    """``evsplat WORD ...`` with quotes where a shell needs them.

    The program is named as it was called where that is a path to it, such as ``.venv/bin/evsplat``.
    """
    return shlex.join([_program(), *map(_word, words)])


def _word(word: Path | str) -> str:
    """A path that begins with a dash would be taken for an option."""
    text = str(word)
    return f"./{text}" if isinstance(word, Path) and text.startswith("-") else text


def _program() -> str:
    called = Path(sys.argv[0])
    return str(called) if called.name == "evsplat" and not called.is_absolute() else "evsplat"
