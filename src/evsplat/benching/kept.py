"""Records that a repository keeps, a few KB each, without pictures: a bench starts from them."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from evsplat.benching.cell import DONE, CaptureSource, Cell, read_cell_record
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import Plan, cells_of
from evsplat.benching.suite import Suite, SuiteCapture
from evsplat.files import make_folder, write_text

_DIGITS = 7
"""Of figures, more than any table prints."""
_LEFT_OUT = ("reasons",)
_OF_FRAME = ("frame", "time_us")


def keep(plan: Plan, folder: BenchFolder, cells: Iterable[Cell]) -> None:
    """Put those of ``cells`` that are finished and not kept yet with the kept records.

    Rows of ``--add`` are not kept: nobody else has their pictures.
    """
    added = {row.name for row in plan.suite.rows if row.added}
    for cell in cells:
        own, kept = folder.record_of(cell.id), folder.kept_record_of(cell.id)
        if kept is None or kept.exists() or cell.row in added or not own.exists():
            continue
        record = read_cell_record(own)
        if record["status"] == DONE:
            make_folder(kept.parent)
            write_text(kept, json.dumps(compact(record), allow_nan=False) + "\n")


def compact(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record of a few KB: of single frames the figures of protocol standard, no pictures."""
    frames = [
        {
            **{key: entry[key] for key in _OF_FRAME if key in entry},
            "protocols": {
                "standard": {
                    region: {name: value for name, value in values.items() if value is not None}
                    for region, values in entry["protocols"]["standard"].items()
                }
            },
        }
        for entry in record["per_frame"]
    ]
    short = {key: value for key, value in record.items() if key not in _LEFT_OUT}
    rounded: dict[str, Any] = _rounded(short | {"per_frame": frames})
    return rounded


def plan_of_kept(suite: Suite, named: str, kept: Path) -> Plan:
    """The suite's plan on the captures and seeds that have records in ``kept``.

    No capture needs to be there: a record says all that its cell was asked for.
    """
    sources: dict[str, CaptureSource] = {}
    seeds: set[int] = set()
    for path in sorted(kept.glob("*/*/seed*.json")):
        asked = read_cell_record(path)["cell"]
        name = path.parts[-3]
        sources[name] = CaptureSource(name, Path("captures") / name, asked["fingerprint"])
        seeds.add(asked["seed"])
    captures = tuple(SuiteCapture(name, str(source.path)) for name, source in sources.items())
    suite = replace(suite, captures=captures, seeds=tuple(sorted(seeds)) or suite.seeds)
    cells = tuple(cells_of(suite, sources.values()))
    return Plan(suite, sources, {}, cells, named, suite.draw.seed if suite.draw else None)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    return [_rounded(one) for one in value] if isinstance(value, list) else value
