"""The verb ``bench``: run what is left of a suite, then write its tables and its page."""

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol

import torch

from evsplat.benching.cell import FAILED, Cell
from evsplat.benching.folder import BenchFolder, exclusive
from evsplat.benching.local import LocalPool
from evsplat.benching.output import write_output
from evsplat.benching.plan import Plan, left_to_do, make_plan
from evsplat.benching.progress import Progress
from evsplat.benching.suite import read_suite
from evsplat.errors import ConfigError
from evsplat.files import read_json, write_json
from evsplat.options import BenchOptions
from evsplat.options.declare import given
from evsplat.render import choose_device


class Executor(Protocol):
    """Where cells run."""

    def run(self, cells: Sequence[Cell]) -> Iterator[tuple[Cell, str | None]]:
        """Each cell as it ends, with the reason where its process ended without a record.

        Closing the iterator stops what runs, after saving.
        """
        ...


class Stopped(KeyboardInterrupt):
    """The bench was interrupted; what is finished is kept, what ran is saved."""

    def __init__(self, folder: Path, done: int, total: int) -> None:
        super().__init__(f"Stopped: {done} of {total} cells are done and kept in {folder}.")
        self.folder = folder


def bench(suite: Path | str, options: BenchOptions | None = None, **changes: Any) -> Path:
    """Run every cell of a suite that has no record yet; gives the results folder.

    ``suite`` is the name of one that ships or a YAML file (docs/bench.md); ``changes`` are fields
    of `BenchOptions`: ``bench("stage", max_minutes=3)``. A time limit replaces the suite's number
    of steps. A cell that failed stays so unless ``retry``.

    Raises:
        ConfigError: The suite or an option is wrong, or the folder holds cells that were asked for
            otherwise.
        Stopped: Ctrl-C; the same call goes on.
    """
    options = given(BenchOptions, options, changes)
    plan_suite = read_suite(suite)
    folder = BenchFolder(Path(options.out or Path("bench") / plan_suite.name))
    plan = make_plan(plan_suite, folder, options)
    if not plan.cells:
        raise ConfigError("\n".join(plan.missing.values()))
    with exclusive(folder.lock_of("bench"), wait=False):
        # What a killed bench left half made.
        for half in folder.captures.glob(".*"):
            shutil.rmtree(half, ignore_errors=True)
        todo = left_to_do(plan, folder, retry=options.retry)
        executor = _executor(folder, len(todo), options)
        try:
            _run(plan, todo, folder, executor)
        except KeyboardInterrupt:
            write_output(plan, folder)
            done = sum(folder.record_of(cell.id).exists() for cell in plan.cells)
            raise Stopped(folder.path, done, len(plan.cells)) from None
        write_output(plan, folder)
    return folder.path


def _run(plan: Plan, todo: Sequence[Cell], folder: BenchFolder, executor: Executor) -> None:
    with (
        _stopped_by_signals(),
        Progress(plan, todo, folder) as progress,
        closing(executor.run(todo)) as ends,  # type: ignore[type-var]
    ):
        for cell, reason in ends:
            if not folder.record_of(cell.id).exists():
                record = {"status": FAILED, "reason": reason or "it ended without a record"}
                write_json(folder.record_of(cell.id), {"cell": cell.request(), **record})
            progress.ended(cell, read_json(folder.record_of(cell.id)))


def _executor(folder: BenchFolder, cells: int, options: BenchOptions) -> Executor:
    """Where to run ``cells`` cells."""
    cpus, path = options.cpus_per_cell, folder.path.resolve()
    if options.ray is not None:
        from evsplat.benching.ray_cluster import RayCluster

        gpus = options.gpus_per_cell or 0
        return RayCluster(path, options.ray, cpus or 1, gpus, options.device)
    device = choose_device(options.device)
    cores = _cores()
    on_gpu = torch.cuda.device_count() if device == "cuda" else 0
    jobs = options.jobs or max(1, min(on_gpu or cores // (cpus or 1), cells))
    threads = cpus or max(1, cores // jobs)
    return LocalPool(path, jobs, threads, device, on_gpu)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """A batch system's SIGTERM saves and stops as Ctrl-C does, in the background too."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        previous = [signal.signal(number, interrupt) for number in numbers]
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)
