"""The plan of a suite on this machine: captures found, cells in the order they are run."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from evsplat.benching.cell import (
    FAILED,
    UNTRAINED,
    CaptureSource,
    Cell,
    fingerprint_of,
    fingerprint_of_file,
    read_cell_record,
    restored_at,
)
from evsplat.benching.drawn import drawn_settings
from evsplat.benching.folder import BenchFolder
from evsplat.benching.given_pictures import PICTURES, digest_of
from evsplat.benching.suite import Suite, SuiteCapture, SuiteRow, check_names
from evsplat.errors import ConfigError
from evsplat.files import remove_file
from evsplat.options import BenchOptions, StageSettings
from evsplat.options.declare import given
from evsplat.shipped import demo_capture
from evsplat.untrusted.records import read_record


@dataclass(frozen=True)
class Plan:
    """A suite with the captures and cells of it that can run."""

    suite: Suite
    sources: dict[str, CaptureSource]
    """Captures that are there or can be made, by name."""
    missing: dict[str, str]
    """Captures that are missing, and what to do, by name."""
    cells: tuple[Cell, ...]
    """Untrained rows first, since they take seconds and find what is wrong with a capture."""
    named: str = ""
    """The suite as it was asked for: the name of one that ships, or its file."""
    draw_seed: int | None = None
    """Seed that its captures were drawn with; None where nothing was drawn."""

    def of(self, capture: str, row: str) -> list[Cell]:
        """The cells of one place in the table, one per seed."""
        return [cell for cell in self.cells if (cell.capture.name, cell.row) == (capture, row)]


def make_plan(
    suite: Suite,
    folder: BenchFolder,
    options: BenchOptions | None = None,
    *,
    named: Path | str | None = None,
    **changes: Any,
) -> Plan:
    """Cells of a suite; what options or ``changes`` give replaces what the suite says.

    A time limit or a number of steps replaces the numbers of steps of the suite and of its rows.
    ``named`` is how the suite was asked for, where that is not its name.

    Raises:
        ConfigError: A row does not exist, a number is out of range, or a staged capture has the
            name of a restored one.
    """
    options = given(BenchOptions, options, changes)
    draw = suite.draw
    if draw is not None and options.draw_seed is not None:
        draw = replace(draw, seed=options.draw_seed)
    iterations, seeds, only = options.iterations, options.seeds, options.only
    suite = replace(suite, draw=draw)
    suite = _with_captures(suite, options)
    if options.max_minutes is not None or iterations is not None:
        minutes = options.max_minutes or suite.max_minutes
        rows = tuple(replace(row, iterations=None) for row in suite.rows)
        suite = replace(suite, rows=rows, iterations=iterations, max_minutes=minutes)
    if seeds:
        suite = replace(suite, seeds=tuple(dict.fromkeys(seeds)))
    if only:
        suite = replace(suite, rows=tuple(_chosen(suite.rows, only)))
    if options.add:
        suite = replace(suite, rows=(*suite.rows, *_added(suite.rows, options.add)))
    if not suite.captures:
        raise ConfigError(f"suite {suite.name} names no captures; give some with --captures.")
    sources: dict[str, CaptureSource] = {}
    missing: dict[str, str] = {}
    for capture in suite.captures:
        source = _source(capture, folder)
        if isinstance(source, CaptureSource):
            sources[capture.name] = source
        else:
            missing[capture.name] = source
    cells = tuple(cells_of(suite, sources.values()))
    _check_restored(cells, sources, folder)
    for row in suite.rows:
        if row.pictures and sources and not any(cell.row == row.name for cell in cells):
            raise ConfigError(
                f"{row.pictures}: row {row.name} has pictures of no capture of the suite; expected "
                f"one folder or more out of {', '.join(list(sources)[:5])}."
            )
    return Plan(
        suite, sources, missing, cells, str(named or suite.name), draw.seed if draw else None
    )


def pending_cells(plan: Plan, folder: BenchFolder, *, retry: bool) -> list[Cell]:
    """Cells without a record; ``retry`` forgets the records of failures.

    Raises:
        ConfigError: The folder has a cell of the same place that was asked for otherwise, over or
            begun.
    """
    todo = []
    for cell in plan.cells:
        path = folder.record_there(cell.id)
        if path is None:
            _check_begun(cell, folder)
            todo.append(cell)
            continue
        record = read_cell_record(path)
        if cell.method == PICTURES and record["cell"] != cell.request():
            # Measured again in seconds, and nothing that was trained is lost.
            remove_file(path)
            todo.append(cell)
            continue
        _check_same_request(path, record["cell"], cell.request(), folder)
        if retry and record["status"] == FAILED:
            remove_file(path)
            todo.append(cell)
    return todo


def _check_begun(cell: Cell, folder: BenchFolder) -> None:
    """Refuse to go on with a training that was begun otherwise: it keeps the settings it has."""
    begun, run = folder.request_of(cell.id), folder.run_of(cell.id)
    if cell.trains and begun.exists() and run.exists():
        there = read_record(begun, {"seed": int}, f"remove {run} to begin its cell anew")
        _check_same_request(begun, there, cell.request(), folder)


def _check_restored(
    cells: Iterable[Cell], sources: Mapping[str, CaptureSource], folder: BenchFolder
) -> None:
    """Refuse a staged capture whose folder is the one that a restored capture is made in."""
    staged = {source.path: name for name, source in sources.items() if source.stage is not None}
    for cell in cells if staged else ():
        clash = None
        with suppress(ConfigError):  # what is wrong with a row its record will say
            clash = staged.get(restored_at(folder, cell).resolve()) if cell.restore else None
        if clash is not None:
            raise ConfigError(
                f"capture {clash}: is the name of what row {cell.row} makes of capture "
                f"{cell.capture.name} with {cell.restore}; give the capture another name."
            )


def _with_captures(suite: Suite, options: BenchOptions) -> Suite:
    """The suite with the captures that are drawn, or that the options name."""
    if suite.draw is not None:
        drawn = drawn_settings(suite.draw).items()
        staged = (SuiteCapture(name, stage=settings) for name, settings in drawn)
        suite = replace(suite, captures=tuple(staged))
    elif options.draw_seed is not None:
        raise ConfigError(
            f"--seed {options.draw_seed}: suite {suite.name} draws no captures at random; leave "
            "it out, or give seeds of training with --seeds."
        )
    if not options.captures:
        return suite
    of_suite = {capture.name: capture for capture in suite.captures}
    named = [
        of_suite[str(path)]
        if str(path) in of_suite and not (path / "capture.json").exists()
        else SuiteCapture(path.resolve().name, str(path))
        for path in map(Path, options.captures)
    ]
    check_names("capture", [capture.name for capture in named], "--captures")
    return replace(suite, captures=tuple(named))


def _added(rows: Sequence[SuiteRow], added: Sequence[str]) -> list[SuiteRow]:
    """Rows of pictures that were made elsewhere, from NAME=FOLDER."""
    found = []
    for text in added:
        name, _, folder = text.partition("=")
        # An empty path would be the working directory.
        if not name or not folder or not Path(folder).is_dir():
            raise ConfigError(
                f"--add {text}: expected NAME=FOLDER, where FOLDER holds a folder of pictures per "
                "capture."
            )
        found.append(
            SuiteRow(name, PICTURES, title=f"{name} (given pictures)", pictures=folder, added=True)
        )
    check_names("row", [row.name for row in (*rows, *found)], "--add")
    return found


def cells_of(suite: Suite, sources: Iterable[CaptureSource]) -> list[Cell]:
    """All cells of a suite on these captures, in the order they are run."""
    cells = [
        _cell(suite, source, row, seed)
        for seed in suite.seeds
        for source in sources
        for row in suite.rows
        # What is not trained has no seed.
        if row.method not in UNTRAINED or seed == suite.seeds[0]
        if row.pictures is None or (Path(row.pictures) / source.name).is_dir()
    ]
    return sorted(cells, key=lambda cell: cell.trains)


def _cell(suite: Suite, source: CaptureSource, row: SuiteRow, seed: int) -> Cell:
    trains = row.method not in UNTRAINED
    pictures = Path(row.pictures) / source.name if row.pictures else None
    return Cell(
        source,
        row.name,
        seed,
        row.method,
        row.restore,
        row.settings if trains else (),
        (row.iterations or suite.iterations) if trains else None,
        suite.max_minutes if trains else None,
        row.backdrop,
        None if pictures is None else str(pictures.resolve()),
        None if pictures is None else digest_of(pictures),
    )


def _chosen(rows: Sequence[SuiteRow], only: Sequence[str]) -> list[SuiteRow]:
    names = [row.name for row in rows]
    for name in only:
        if name not in names:
            raise ConfigError(f"--only {name}: no such row; rows are {', '.join(names)}.")
    return [row for row in rows if row.name in only]


def _source(capture: SuiteCapture, folder: BenchFolder) -> CaptureSource | str:
    """The capture, or a sentence that says how to get it."""
    if capture.stage is not None:
        made = folder.captures.resolve() / capture.name
        return CaptureSource(
            capture.name, made, fingerprint_of(_request(capture.stage)), capture.stage
        )
    assert capture.path is not None
    path = demo_capture() if capture.path == "demo" else Path(capture.path)
    description = path / "capture.json"
    if not description.is_file():
        how = f"make it with `{capture.get}`" if capture.get else "check the path"
        return f"{path}: capture not found; {how}, or name captures with --captures."
    return CaptureSource(capture.name, path.resolve(), fingerprint_of_file(description))


def _request(settings: StageSettings) -> bytes:
    """What of the settings is not at its default, so that a new option leaves kept records fit."""
    usual = asdict(StageSettings())
    chosen = {name: value for name, value in asdict(settings).items() if value != usual[name]}
    return json.dumps(chosen, sort_keys=True).encode()


def _check_same_request(
    path: Path, there: dict[str, Any], asked: dict[str, Any], folder: BenchFolder
) -> None:
    for key, value in asked.items():
        if there.get(key) != value:
            own = path.is_relative_to(folder.path)
            raise ConfigError(
                f"{path}: was made with {key} {there.get(key)!r}, and {value!r} is asked for; "
                f"choose another {'--out' if own else '--records'}, or remove "
                f"{folder.path if own else 'this file'} to begin anew."
            )
