"""Records of cells put together: means over captures with their spread over seeds."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from evsplat.benching.cell import DONE, read_cell_record
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import Plan
from evsplat.evaluation.tables import Figure

Record = dict[str, Any]


@dataclass(frozen=True)
class Records:
    """Everything that a results folder knows about a plan."""

    plan: Plan
    by_cell: dict[tuple[str, str, int], Record]
    """Records by (capture, row, seed); cells without one are not in it."""

    @classmethod
    def read(cls, plan: Plan, folder: BenchFolder) -> "Records":
        """Read the record of every cell that has one."""
        found = {}
        for cell in plan.cells:
            path = folder.record_there(cell.id)
            if path is not None:
                found[cell.capture.name, cell.row, cell.seed] = read_cell_record(path)
        return cls(plan, found)

    @property
    def captures(self) -> list[str]:
        """Captures that could be run."""
        return list(self.plan.sources)

    def of(self, capture: str, row: str) -> list[Record]:
        """Finished records of a place in the table, by seed."""
        return [
            record
            for (one, other, _), record in sorted(self.by_cell.items())
            if (one, other) == (capture, row) and record["status"] == DONE
        ]

    def drawn(self, capture: str, row: str) -> list[Record]:
        """Those of `of` with pictures in the results folder: kept records have none."""
        found = self.of(capture, row)
        return [r for r in found if all("pictures" in entry for entry in r["per_frame"])]

    def figure(
        self, row: str, value: Callable[[Record], float | None], captures: Iterable[str]
    ) -> Figure | None:
        """The row's mean of ``value`` over those of ``captures`` that have it."""
        by_capture = []
        for capture in captures:
            values = {r["cell"]["seed"]: value(r) for r in self.of(capture, row)}
            known = {seed: number for seed, number in values.items() if number is not None}
            if known:
                by_capture.append(known)
        if not by_capture:
            return None
        seeds = set.intersection(*(set(values) for values in by_capture))
        per_seed = [fmean(values[seed] for values in by_capture) for seed in seeds]
        mean = fmean(fmean(values.values()) for values in by_capture)
        return Figure(mean, stdev(per_seed) if len(per_seed) > 1 else None)

    def reason_for_gap(self, capture: str, row: str) -> str:
        """The reason why a place in the table is empty."""
        for (one, other, _), record in self.by_cell.items():
            if (one, other) == (capture, row):
                done = record["status"] == DONE
                return "measured; pictures not kept" if done else f"failed: {record['reason']}"
        return "not run"

    def failures(self) -> dict[tuple[str, str], list[str]]:
        """Captures that a row failed on, by row and reason."""
        found: dict[tuple[str, str], list[str]] = {}
        for (capture, row, seed), record in self.by_cell.items():
            if record["status"] != DONE:
                where = capture if len(self.plan.suite.seeds) == 1 else f"{capture} seed {seed}"
                found.setdefault((row, record["reason"]), []).append(where)
        return found


def metric(protocol: str, region: str, name: str) -> Callable[[Record], float | None]:
    """The value of a metric in a record."""
    return lambda record: record["protocols"][protocol][region][name]
