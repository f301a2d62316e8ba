"""Options of ``evsplat bench``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from evsplat.config import Above, AtLeast
from evsplat.errors import ConfigError
from evsplat.options.declare import Device, Flag, check_options, option


@dataclass(frozen=True)
class BenchOptions:
    """What of a suite is run, and where; what is given replaces what the suite says."""

    out: Annotated[Path | None, option("FOLDER", default="bench/SUITE")] = None
    """Results folder: tables.md, tables.tex, index.html, one JSON per cell."""
    captures: Annotated[tuple[Path, ...], option("[CAPTURE ...]", default="the suite's")] = ()
    """Captures in place of the suite's."""
    iterations: Annotated[int | None, AtLeast(1), option("N", default="the suite's")] = None
    """Training steps of every cell."""
    max_minutes: Annotated[float | None, Above(0), option("M", default="the suite's")] = None
    """Minutes of training of every cell; schedules are shortened to fit."""
    seeds: Annotated[tuple[int, ...], option("[S ...]", default="the suite's")] = ()
    """Seeds."""
    only: Annotated[tuple[str, ...], option("[ROW ...]", default="all rows")] = ()
    """Rows of the suite to run."""
    jobs: Annotated[int | None, AtLeast(1), option("N", default="one per core or GPU")] = None
    """Cells at a time on this machine; they share its cores."""
    ray: Annotated[str | None, option("ADDRESS|local", default="this machine, no Ray")] = None
    """Ray cluster to run on; local starts one on this machine."""
    cpus_per_cell: Annotated[
        int | None, AtLeast(1), option("N", default="an even share; 1 on Ray")
    ] = None
    """CPU threads of a cell."""
    gpus_per_cell: Annotated[float | None, AtLeast(0), option("G", default="0 on Ray")] = None
    """GPUs of a cell, on Ray."""
    device: Device = "auto"
    """Where to compute."""
    retry: Flag = False
    """Run cells again that failed."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.ray is not None and self.jobs is not None:
            raise ConfigError("--jobs is for this machine; on Ray --cpus-per-cell decides.")
        if self.ray is None and self.gpus_per_cell is not None:
            raise ConfigError("--gpus-per-cell is for --ray; here every process has one GPU.")
