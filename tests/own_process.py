"""Trainings and benches in a process of their own, which can be killed or told to stop.

It is forked from a process that has imported what they need and done nothing with it, once for all
tests beside each other: the import takes seconds, and nothing that becomes of a run asks about it.
"""

import importlib
import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_IMPORTED = ["evsplat.training.train", "evsplat.benching.run", "evsplat.cli"]


def start(
    capture: Path,
    out: Path,
    iterations: int,
    *,
    method: str | None = None,
    settings: Sequence[str] = (),
    resume: bool = False,
    without: Sequence[str] = (),
) -> BaseProcess:
    """A training that saves after every step, started; what it says is in `errors_of`.

    It ends with 1 where one of the modules ``without`` has been imported in the end.
    """
    asked = {"iterations": iterations, "method": method, "overrides": settings, "resume": resume}
    return _started(out, _train, capture, asked, without)


def start_bench(suite: Path, out: Path) -> BaseProcess:
    """``evsplat bench`` of a suite, started; its cells have processes of their own."""
    return _started(out, _bench, suite)


def errors_of(out: Path) -> Path:
    """Standard error of the process that works on a folder."""
    return out.with_name(f"{out.name} errors.txt")


def _started(out: Path, work: Callable[..., None], *given: Any) -> BaseProcess:
    _CONTEXT.set_forkserver_preload(_IMPORTED)
    process = _CONTEXT.Process(target=_telling, args=(work, out, *given), daemon=True)
    process.start()
    return process


def _telling(work: Callable[..., None], out: Path, *given: Any) -> None:
    os.dup2(os.open(errors_of(out), os.O_WRONLY | os.O_CREAT | os.O_TRUNC), sys.stderr.fileno())
    work(out, *given)


def _train(out: Path, capture: Path, asked: dict[str, Any], without: Sequence[str]) -> None:
    importlib.import_module("evsplat.training.loop").CHECKPOINT_SECONDS = 0.0
    importlib.import_module("evsplat.training").train(capture, out=out, threads=1, **asked)
    assert not set(without) & set(sys.modules)


def _bench(out: Path, suite: Path) -> None:
    main = importlib.import_module("evsplat.cli").main
    # The words to go on with are those that the process was started with.
    sys.argv = ["evsplat", "bench", str(suite), "--out", str(out), "--cpus-per-cell", "1"]
    sys.exit(main(sys.argv[1:]))
