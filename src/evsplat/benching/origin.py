"""Which code and which machine a record of a bench is from."""

import subprocess
from functools import cache
from pathlib import Path

from evsplat.devices import hardware

_ROOT = Path(__file__).parents[3]
"""The repository, where the package is not installed apart from it."""
_NO_FIGURE = ("benching", "cli", "export", "film", "importers", "inspection", "options", "view")
"""Folders of the package that change no figure of a cell."""


@cache
def code() -> dict[str, str] | None:
    """``commit`` that last changed what decides figures, and its ``date``; None outside of git.

    Changes that are not committed are told by a ``+`` behind the commit.
    """
    scope = ["native", "src/evsplat", *(f":!src/evsplat/{name}" for name in _NO_FIGURE)]
    if not (_ROOT / ".git").exists():
        return None
    last = _git("log", "-1", "--format=%h %cs", "--", *scope)
    if not last:
        return None
    commit, date = last.split()
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", *scope)
    return {"commit": commit + "+" * bool(changed), "date": date}


def machine() -> str:
    """Processor and GPU by name, and how many cores there are."""
    found = hardware()
    names = [str(found[key]) for key in ("cpu", "gpu") if key in found]
    return ", ".join([*names, f"{found['cpu_cores']} cores"])


def _git(*words: str) -> str:
    """Output of git; empty where it fails or is not installed."""
    try:
        done = subprocess.run(["git", "-C", _ROOT, *words], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
