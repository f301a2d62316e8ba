"""``evsplat bench``: many methods on many captures, in one table."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from evsplat.cli.options import Device, Flag, option


def bench(
    suite: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SUITE")],
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="bench/SUITE")] = None,
    captures: Annotated[tuple[Path, ...], option("[CAPTURE ...]", default="the suite's")] = (),
    iterations: Annotated[int | None, option("N", default="the suite's")] = None,
    max_minutes: Annotated[float | None, option("M", default="the suite's")] = None,
    seeds: Annotated[tuple[int, ...], option("[S ...]", default="the suite's")] = (),
    only: Annotated[tuple[str, ...], option("[ROW ...]", default="all rows")] = (),
    jobs: Annotated[int | None, option("N", default="one per core or GPU")] = None,
    ray: Annotated[str | None, option("ADDRESS|local", default="this machine, no Ray")] = None,
    cpus_per_cell: Annotated[int | None, option("N", default="an even share; 1 on Ray")] = None,
    gpus_per_cell: Annotated[float | None, option("G", default="0 on Ray")] = None,
    device: Device = "auto",
    retry: Flag = False,
) -> None:
    """Run a suite of captures x methods x seeds; write tables and a page.

    What is finished stays: the same command goes on after Ctrl-C, a crash or a kill.

    Args:
        suite: ablation, mmhpsd-blur, stage, zju-mocap-blur or a YAML file (docs/bench.md).
        out: Results folder: tables.md, tables.tex, index.html, one JSON per cell.
        captures: Captures in place of the suite's.
        iterations: Training steps of every cell.
        max_minutes: Minutes of training of every cell; schedules are shortened to fit.
        seeds: Seeds.
        only: Rows of the suite to run.
        jobs: Cells at a time on this machine; they share its cores.
        ray: Ray cluster to run on; local starts one on this machine.
        cpus_per_cell: CPU threads of a cell.
        gpus_per_cell: GPUs of a cell, on Ray.
        device: Where to compute.
        retry: Run cells again that failed.
    """
    from evsplat.benching.run import Stopped
    from evsplat.benching.run import bench as run_bench

    try:
        folder = run_bench(
            suite,
            out=out,
            captures=captures,
            iterations=iterations,
            max_minutes=max_minutes,
            seeds=seeds,
            only=only,
            jobs=jobs,
            ray=ray,
            cpus_per_cell=cpus_per_cell,
            gpus_per_cell=gpus_per_cell,
            device=device,
            retry=retry,
        )
    except Stopped as stop:
        command = shlex.join(["evsplat", *sys.argv[1:]])
        raise KeyboardInterrupt(f"{stop} Go on with: {command}") from None
    print(f"tables: {folder / 'tables.md'}\npage:   {folder / 'index.html'}")
