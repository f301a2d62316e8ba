"""The verb ``bench``: run what is left of a suite, then write its tables and its page."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from evsplat.benching.cell import FAILED, Cell
from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder, exclusive
from evsplat.benching.kept import keep
from evsplat.benching.local import LocalPool
from evsplat.benching.page import page
from evsplat.benching.plan import Plan, make_plan, pending_cells
from evsplat.benching.ray_cluster import RayCluster
from evsplat.benching.strips import write_strips
from evsplat.benching.suite import read_suite
from evsplat.benching.tables import SPREAD, make_tables
from evsplat.benching.unmasked import unmasked
from evsplat.benching.unweighted import unweighted
from evsplat.errors import ConfigError
from evsplat.evaluation.tables import LEGEND, latex, markdown
from evsplat.files import try_target, write_json, write_text
from evsplat.options import BenchOptions
from evsplat.options.declare import given
from evsplat.render import choose_device
from evsplat.untrusted.faults import MISFITS, broken_as
from evsplat.untrusted.text import read_json
from evsplat.wording import counted

Executor = LocalPool | RayCluster
"""Processes that cells run in."""
_REFRESH_S = 1.0
_REASON_LENGTH = 200


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
    read = read_suite(suite)
    folder = BenchFolder(Path(options.out or Path("bench") / read.name), options.records)
    try_target(folder.path)
    plan = make_plan(read, folder, options, named=suite)
    if not plan.cells:
        raise ConfigError("\n".join(plan.missing.values()))
    with exclusive(folder.lock_of("bench"), wait=False):
        todo = pending_cells(plan, folder, retry=options.retry)
        keep(plan, folder, plan.cells)
        # Of all cells, done or not: how many threads a cell has decides its last bits.
        executor = _executor(folder, len(plan.cells), options)
        try:
            _run(plan, todo, folder, executor)
        except KeyboardInterrupt:
            write_output(plan, folder)
            done = sum(folder.record_there(cell.id) is not None for cell in plan.cells)
            raise Stopped(folder.path, done, len(plan.cells)) from None
        write_output(plan, folder)
    return folder.path


def _run(plan: Plan, todo: Sequence[Cell], folder: BenchFolder, executor: Executor) -> None:
    told = [*plan.missing.values(), *unmasked(todo)]
    if isinstance(executor, LocalPool):  # Ray's machines have weights of their own
        told += unweighted(todo, folder)
    with (
        _stopped_by_signals(),
        Progress(plan, todo, folder, told) as progress,
        closing(executor.run(todo)) as ends,
    ):
        for cell, reason in ends:
            if not folder.record_of(cell.id).exists():
                record = {"status": FAILED, "reason": reason or "it ended without a record"}
                write_json(folder.record_of(cell.id), {"cell": cell.request(), **record})
            progress.ended(cell, read_json(folder.record_of(cell.id)))
            keep(plan, folder, [cell])


def _executor(folder: BenchFolder, cells: int, options: BenchOptions) -> Executor:
    """The executor of ``cells`` cells that the options ask for."""
    cpus, path = options.cpus_per_cell, folder.path.resolve()
    if options.ray is not None:
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


class Progress:
    """A line on stderr for every cell that ends, and one that says how far the bench is."""

    def __init__(
        self, plan: Plan, todo: Sequence[Cell], folder: BenchFolder, told: Sequence[str]
    ) -> None:
        """``told``: sentences on what will not run, printed before anything does."""
        self._titles = {row.name: row.label for row in plan.suite.rows}
        self._total, self._ended, self._failed = len(todo), 0, 0
        self._trained, self._to_train = 0, sum(cell.trains for cell in todo)
        self._started = time.monotonic()
        suite, done = plan.suite, len(plan.cells) - len(todo)
        _print(
            f"suite {suite.name}: {counted(len(plan.sources), 'capture')} x "
            f"{counted(len(suite.rows), 'row')} x {counted(len(suite.seeds), 'seed')}; "
            f"{counted(len(todo), 'cell')} to do, {done} done before; "
            f"logs in {folder.path / 'logs'}"
        )
        for sentence in told:
            _print(sentence)
        self._bar = tqdm(
            total=len(todo),
            bar_format="{n_fmt}/{total_fmt} cells |{bar:24}| {elapsed}{postfix}",
            disable=not sys.stderr.isatty(),
            dynamic_ncols=True,
        )
        self._over = threading.Event()
        self._beat = threading.Thread(target=self._refresh, daemon=True)
        self._beat.start()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._beat.join()
        self._bar.close()

    def ended(self, cell: Cell, record: dict[str, Any]) -> None:
        """Print the outcome of a cell."""
        self._ended += 1
        if record["status"] == FAILED:
            self._failed += 1
            self._to_train -= cell.trains  # it took no time that tells of the others'
            outcome = f"failed: {record['reason'][:_REASON_LENGTH]}"
        else:
            self._trained += cell.trains
            figures = record["protocols"]["standard"]
            psnr = [figures[region]["psnr"] for region in ("full", "person_crop", "person_mask")]
            shown = " / ".join("–" if value is None else f"{value:.2f}" for value in psnr)
            outcome = f"{shown} dB (full / crop / mask), {record['seconds'] / 60:.1f} min"
        place = f"{cell.capture.name} · {self._titles[cell.row]} · seed {cell.seed}"
        _print(f"[{self._ended}/{self._total}{self._left()}] {place}: {outcome}")
        self._bar.set_postfix_str(f"{self._failed} failed{self._left()}", refresh=False)
        self._bar.update()

    def _left(self) -> str:
        """Expected time to the end, by the cells that train; empty before the first of them."""
        if not self._trained:
            return ""
        elapsed = time.monotonic() - self._started
        minutes = elapsed / self._trained * (self._to_train - self._trained) / 60
        return f", {minutes:.0f} min left"

    def _refresh(self) -> None:
        while not self._over.wait(_REFRESH_S):
            self._bar.refresh()


def _print(text: str) -> None:
    tqdm.write(text, file=sys.stderr)


def write_output(plan: Plan, folder: BenchFolder) -> None:
    """Write tables.md, tables.tex, index.html and strips of what has been recorded so far."""
    records = Records.read(plan, folder)
    title = plan.suite.title or plan.suite.name
    intro = f"{LEGEND.format(second='in italics')} {SPREAD}"
    remedy = "remove the record that was changed, and its cell is run again"
    with broken_as(folder.path / "cells", "not as the bench wrote them", remedy, kinds=MISFITS):
        tables = make_tables(records)
        html = page(records, tables, folder)
        write_strips(records, folder)
    write_text(folder.path / "tables.md", markdown(title, intro, tables))
    write_text(folder.path / "tables.tex", latex(tables))
    write_text(folder.path / "index.html", html)
