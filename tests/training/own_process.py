"""A training in a process of its own, which saves after every step and can be killed.

It is forked from a process that has imported what trains and done nothing with it, once for all
tests beside each other: the import takes seconds, and nothing that becomes of a run asks about it.
"""

import importlib
import multiprocessing
import os
import sys
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver")


def start(
    capture: Path,
    out: Path,
    iterations: int,
    *,
    method: str,
    settings: Sequence[str],
    without: Sequence[str] = (),
) -> BaseProcess:
    """The process, started; what it says is in `errors_of`.

    It ends with 1 where one of the modules ``without`` has been imported in the end.
    """
    _CONTEXT.set_forkserver_preload(["evsplat.training.train"])
    given = (capture, out, iterations, method, settings, without)
    process = _CONTEXT.Process(target=_train, args=given, daemon=True)
    process.start()
    return process


def errors_of(out: Path) -> Path:
    """Standard error of the process that trains into a folder."""
    return out.with_name(f"{out.name} errors.txt")


def _train(
    capture: Path,
    out: Path,
    iterations: int,
    method: str,
    settings: Sequence[str],
    without: Sequence[str],
) -> None:
    os.dup2(os.open(errors_of(out), os.O_WRONLY | os.O_CREAT | os.O_TRUNC), sys.stderr.fileno())
    training = importlib.import_module("evsplat.training.train")
    training.CHECKPOINT_SECONDS = 0.0
    training.train(
        capture, out=out, iterations=iterations, method=method, overrides=settings, threads=1
    )
    assert not set(without) & set(sys.modules)
