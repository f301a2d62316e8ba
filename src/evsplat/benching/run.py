"""The verb ``bench``: run what is left of a suite, then write its tables and its page."""

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Protocol

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


def bench(
    suite: Path | str,
    *,
    out: Path | str | None = None,
    captures: Sequence[Path | str] = (),
    iterations: int | None = None,
    max_minutes: float | None = None,
    seeds: Sequence[int] = (),
    only: Sequence[str] = (),
    jobs: int | None = None,
    ray: str | None = None,
    cpus_per_cell: int | None = None,
    gpus_per_cell: float | None = None,
    device: str = "auto",
    retry: bool = False,
) -> Path:
    """Run every cell of a suite that has no record yet; gives the results folder.

    ``suite`` is the name of one that ships or a YAML file (docs/bench.md); ``out`` is
    ``bench/<suite>`` by default. ``captures`` replace those of the suite; ``iterations``,
    ``max_minutes`` (of each cell; the schedule is shortened to be finished by then) and ``seeds``
    replace its numbers; ``only`` are names of rows. Cells run in ``jobs`` processes on this
    machine, which share its cores, or on the Ray cluster at ``ray`` (``local`` starts one), each
    with ``cpus_per_cell`` and ``gpus_per_cell``. A cell that failed stays so unless ``retry``.

    Raises:
        ConfigError: The suite or an option is wrong, or the folder holds cells that were asked for
            otherwise.
        Stopped: Ctrl-C; the same call goes on.
    """
    plan_suite = read_suite(suite)
    folder = BenchFolder(Path(out) if out is not None else Path("bench") / plan_suite.name)
    plan = make_plan(
        plan_suite,
        folder,
        captures=captures,
        iterations=iterations,
        max_minutes=max_minutes,
        seeds=seeds,
        only=only,
    )
    if not plan.cells:
        raise ConfigError("\n".join(plan.missing.values()))
    with exclusive(folder.lock_of("bench"), wait=False):
        # What a killed bench left half made.
        for half in folder.captures.glob(".*"):
            shutil.rmtree(half, ignore_errors=True)
        todo = left_to_do(plan, folder, retry=retry)
        executor = _executor(
            folder,
            len(todo),
            jobs=jobs,
            ray=ray,
            cpus=cpus_per_cell,
            gpus=gpus_per_cell,
            device=device,
        )
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


def _executor(
    folder: BenchFolder,
    cells: int,
    *,
    jobs: int | None,
    ray: str | None,
    cpus: int | None,
    gpus: float | None,
    device: str,
) -> Executor:
    """Where to run ``cells`` cells, after a look at the options."""
    for name, value in (("--jobs", jobs), ("--cpus-per-cell", cpus)):
        if value is not None and value < 1:
            raise ConfigError(f"{name} {value}: expected at least 1.")
    if gpus is not None and gpus < 0:
        raise ConfigError(f"--gpus-per-cell {gpus:g}: expected 0 or more.")
    if ray is not None:
        if jobs is not None:
            raise ConfigError("--jobs is for this machine; on Ray --cpus-per-cell decides.")
        from evsplat.benching.ray_cluster import RayCluster

        return RayCluster(folder.path.resolve(), ray, cpus or 1, gpus or 0, device)
    if gpus is not None:
        raise ConfigError("--gpus-per-cell is for --ray; here every process has one GPU.")
    device = choose_device(device)
    cores = _cores()
    on_gpu = torch.cuda.device_count() if device == "cuda" else 0
    jobs = jobs or max(1, min(on_gpu or cores // (cpus or 1), cells))
    threads = cpus or max(1, cores // jobs)
    return LocalPool(folder.path.resolve(), jobs, threads, device, on_gpu)


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
