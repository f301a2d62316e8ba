"""Suites small enough for tests, and what their records say apart from times and commits."""

import importlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from evsplat.benching.cell import run_cell
from evsplat.benching.local import LocalPool

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
    """Record of every cell, as `untimed` leaves it."""
    return {
        path.relative_to(folder / "cells").as_posix(): untimed(json.loads(path.read_text()))
        for path in sorted((folder / "cells").rglob("*.json"))
    }


def untimed(record: dict[str, Any]) -> dict[str, Any]:
    """A record, line of a log or metrics.json without what depends on the clock.

    Without the commit either: the repository may be committed to, or changed, between two of them.
    """
    timed = {"seconds", "train_seconds", "train_cpu_seconds", "evaluate_seconds"}
    apart = timed | {"peak_memory_mb", "code"}
    return {key: value for key, value in record.items() if key not in apart}


class _InThisProcess(LocalPool):
    """Cells one after another, on one thread as tests beside each other share the cores.

    Without the seconds in which a process of their own starts.
    """

    def run(self, cells):
        for cell in cells:
            run_cell(self.folder, cell, threads=1, device=self.device)
            yield cell, None


@contextmanager
def cells_in_this_process() -> Iterator[None]:
    """Benches within ask what becomes of cells; test_bench.py asks about their processes."""
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        # The package has a function of the module's name.
        patch.setattr(importlib.import_module("evsplat.benching.run"), "LocalPool", _InThisProcess)
        yield
    torch.set_num_threads(threads)
