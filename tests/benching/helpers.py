"""Suites small enough for tests, and what their records say apart from times."""

import json
from pathlib import Path

import yaml

from ..small_model import SMALL

PAPER = {"name": "paper", "method": "paper", "settings": list(SMALL["paper"])}
MEDIAN = {"name": "median", "method": "median_background"}


def write_suite(path: Path, captures: dict[str, Path], *rows: dict, iterations: int = 12) -> Path:
    suite = {
        "name": "tiny",
        "iterations": iterations,
        "captures": [{"name": name, "path": str(where)} for name, where in captures.items()],
        "rows": list(rows),
    }
    path.write_text(yaml.safe_dump(suite))
    return path


def records(folder: Path) -> dict[str, dict]:
    """Record of every cell without what depends on the clock."""
    timed = {"seconds", "train_seconds", "train_cpu_seconds", "peak_memory_mb"}
    found = {}
    for path in sorted((folder / "cells").rglob("*.json")):
        record = json.loads(path.read_text())
        found[path.relative_to(folder / "cells").as_posix()] = {
            key: value for key, value in record.items() if key not in timed
        }
    return found
