"""Write the tables of README.md and the docs from the records that the repository keeps.

    python tools/results.py [--check]

Each place between ``<!-- results: NAME -->`` and ``<!-- end of results -->`` in `PAGES` is made
anew from docs/results, and the convergence figure is drawn. ``--check`` writes nothing and ends
with 1 where a page says something else. Records come there by ``evsplat bench SUITE --records
docs/results/SUITE`` and by benchmarks/convergence.py.
"""

import argparse
import itertools
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from convergence import curves_of, draw, knee, read_points  # noqa: E402

from evsplat.benching.figures import Record, Records, metric  # noqa: E402
from evsplat.benching.folder import BenchFolder  # noqa: E402
from evsplat.benching.kept import plan_of_kept  # noqa: E402
from evsplat.benching.plan import pending_cells  # noqa: E402
from evsplat.benching.suite import SuiteRow, read_suite  # noqa: E402
from evsplat.benching.tables import machines, make_tables, origins, title_of  # noqa: E402
from evsplat.capture.policy import STRICT_TERMS  # noqa: E402
from evsplat.evaluation.tables import LEGEND, REGION_TITLES, markdown  # noqa: E402

KEPT = ROOT / "docs" / "results"
PAGES = ("README.md", "docs/bench.md", "docs/results.md")
FIGURE = ROOT / "docs" / "images" / "convergence.png"
LONGER = ROOT / "benchmarks" / "knee.yaml"
"""Suite of rows of ``stage`` that make more steps."""
_STEPS = re.compile(r"_\d+$")
"""Ends the names of its rows that ran longer still, each below one of half its steps."""
COMPARED = ("man_dance_hard_256", "woman_dance_b_256", "real_beam_256")
"""Captures that every method is compared on."""
FOR_USERS = (
    "own_picture",
    "avatar3dgs_semantic",
    "hugs",
    "edi_avatar3dgs_semantic",
    "paper_no_events",
    "paper",
    "evsplat",
    "evsplat_video",
)
"""Rows of the short table."""
FOUND = {
    "_found_poses": "poses found by `evsplat poses`",
    "_found_poses_by_events": "poses found by `evsplat poses --held-out-events`",
}
"""Ends of the names of captures whose given poses were left out, and what is said of them."""
GAIN_DB = 0.2
"""Less than so much from a doubling of the steps ends a curve of benchmarks/convergence.py."""
_OF_POINT = ("full_psnr_db", "crop_psnr_db", "mask_psnr_db")
_PLACE = re.compile(r"(<!-- results: ([a-z-]+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def kept_records(named: str | Path) -> Records:
    """Everything kept of a suite; a record that it asks for otherwise is a `ConfigError`."""
    suite = read_suite(named)
    folder = BenchFolder(ROOT / "build" / "results" / suite.name, KEPT / suite.name)
    plan = plan_of_kept(suite, str(named), KEPT / suite.name)
    pending_cells(plan, folder, retry=False)
    return Records.read(plan, folder)


def _only(records: Records, captures: Sequence[str]) -> Records:
    """Some captures in their order, and the rows that have run on one of them."""
    plan = records.plan
    sources = {name: plan.sources[name] for name in captures if name in plan.sources}
    cells = tuple(cell for cell in plan.cells if cell.capture.name in sources)
    found = {key: record for key, record in records.by_cell.items() if key[0] in sources}
    run = {row for _, row, _ in found}
    suite = replace(plan.suite, rows=tuple(row for row in plan.suite.rows if row.name in run))
    return Records(replace(plan, suite=suite, sources=sources, cells=cells), found)


def trio(records: Records, row: str, capture: str) -> str:
    """PSNR of full frame / person crop / person mask, the largest spread over seeds behind it."""
    found = [
        figure
        for region in REGION_TITLES
        if (figure := records.figure(row, metric("standard", region, "psnr"), [capture]))
    ]
    spreads = [figure.spread for figure in found if figure.spread is not None]
    text = " / ".join(f"{figure.mean:.2f}" for figure in found) or "–"
    return text + (f" (± {max(spreads):.2f})" if spreads else "")


@dataclass(frozen=True)
class _Line:
    """A line of the table of methods."""

    title: str
    row: str
    """The row's name in the suite."""
    places: list[tuple[Records, str, str]]
    """For every compared capture: the records, the row and the capture that it is of."""
    from_suite: bool = False
    """Whether it is of the suite's own lengths, which every row has."""


def methods(records: Records, longer: Records) -> str:
    """Every row on the captures that all methods are compared on.

    Below a row stands the same of ``longer`` runs, where every capture has one.
    """
    return _table(records, _every_length(records, longer))


def at_knee(records: Records, longer: Records) -> str:
    """The rows of the short table, each on every capture with as many steps as pay."""
    rule = (
        "Steps are those of each method at its knee on each capture, the first length whose "
        f"doubling brings less than {GAIN_DB} dB of the crop, or the longest that has run."
    )
    return _table(records, _at_their_knees(records, longer), rule)


def _table(records: Records, rows: Iterable[_Line], *remarks: str) -> str:
    """Lines with their figures; ``remarks`` stand below with what all figures have in common."""
    lines = [
        f"| method | steps | {' | '.join(COMPARED)} | CPU minutes |",
        f"|---|---:|{'---|' * len(COMPARED)}---:|",
    ]
    missing = []
    for line in rows:
        figures = [trio(*place) for place in line.places]
        gaps = [name for name, figure in zip(COMPARED, figures, strict=True) if figure == "–"]
        if gaps and line.from_suite:
            where = "" if len(gaps) == len(COMPARED) else f" on {', '.join(gaps)}"
            missing.append(f"`{line.row}`{where}")
        if len(gaps) == len(COMPARED):
            continue
        seconds = _of_places(line, lambda record: record.get("train_cpu_seconds"))
        lines.append(
            f"| {line.title} | {_steps(line)} | {' | '.join(figures)} | "
            f"{f'{fmean(seconds) / 60:.1f}' if seconds else '–'} |"
        )
    notes = [
        "PSNR in dB of full frame / person crop / person mask, protocol `standard`, "
        f"{_test_frames(records)} test frames; one seed where no ± follows, which is the largest "
        f"standard deviation of the three over seeds. {STRICT_TERMS}",
        *remarks,
        *machines(records),
        "CPU minutes are the processor's of the training alone, which ran beside other work; the "
        "mean over what the row has. The commit of every cell is in docs/results.md.",
    ]
    if missing:
        notes.append(f"Not run yet: {'; '.join(missing)}.")
    return "\n".join([*lines, "", " ".join(notes)])


def _steps(line: _Line) -> str:
    """Training steps, of each capture where they differ."""
    found = [f"{steps:,.0f}" for steps in _of_places(line, lambda record: record["iteration"])]
    return " / ".join(found if len(set(found)) > 1 else found[:1]) or "–"


def _of_places(line: _Line, value: Callable[[Record], float | None]) -> list[float]:
    """The mean of a value over the seeds of each place that has it."""
    figures = [of.figure(row, value, [capture]) for of, row, capture in line.places]
    return [figure.mean for figure in figures if figure]


def _line(of: Records, row: SuiteRow, captures: Sequence[str], said: str = "") -> _Line:
    places = [(of, row.name, capture) for capture in captures]
    return _Line(title_of(of, row, captures) + said, row.name, places)


def _every_length(records: Records, longer: Records) -> Iterator[_Line]:
    """All rows; again those that ran longer or by found poses."""
    for row in records.plan.suite.rows:
        yield replace(_line(records, row, COMPARED), from_suite=True)
        if all(longer.of(capture, row.name) for capture in COMPARED):
            yield _line(longer, row, COMPARED)
        yield from _by_found_poses(records, row)


def _at_their_knees(records: Records, longer: Records) -> Iterator[_Line]:
    """The rows for users at the knee of each capture; again those by found poses."""
    for row in (row for row in records.plan.suite.rows if row.name in FOR_USERS):
        places = [(*_knee_of(records, longer, row.name, capture), capture) for capture in COMPARED]
        yield replace(_line(records, row, COMPARED), places=places, from_suite=True)
        yield from _by_found_poses(records, row)


def _by_found_poses(records: Records, row: SuiteRow) -> Iterator[_Line]:
    for end, words in FOUND.items():
        found = [capture + end for capture in COMPARED]
        if any(records.of(capture, row.name) for capture in found):
            yield _line(records, row, found, f"; {words}")


def _knee_of(records: Records, longer: Records, name: str, capture: str) -> tuple[Records, str]:
    """Records and row of the first length that a doubling improves by too little, or the last."""
    crop = metric("standard", "person_crop", "psnr")
    rows = [(records, name), *((longer, row) for row in _lengths(longer, name))]
    run = [(of, row) for of, row in rows if of.of(capture, row)] or rows[:1]
    means = [figure.mean for of, row in run if (figure := of.figure(row, crop, [capture]))]
    pays = (after - before >= GAIN_DB for before, after in itertools.pairwise(means))
    return run[sum(1 for _ in itertools.takewhile(bool, pays))]


def _lengths(longer: Records, name: str) -> list[str]:
    """Rows that ran a row of the suite for longer, as `LONGER` has them: from short to long."""
    return [row.name for row in longer.plan.suite.rows if _STEPS.sub("", row.name) == name]


def _test_frames(records: Records) -> str:
    counts = []
    for capture in COMPARED:
        found = [r for row in records.plan.suite.rows for r in records.of(capture, row.name)]
        counts += [str(found[0]["frames"]["test"])] if found else []
    return " + ".join(counts)


def captures(records: Records) -> str:
    """`evsplat` and `paper` on every capture, beside what needs no method."""
    rows = ("evsplat", "paper", "nearest_frame", "own_picture")
    names = [name for name in records.captures if not name.endswith(tuple(FOUND))]
    lines = [
        "| capture | `evsplat` | `paper` | nearest training frame | own blurry picture |",
        "|---|---|---|---|---|",
        *(f"| {n} | {' | '.join(trio(records, row, n) for row in rows)} |" for n in names),
    ]
    return "\n".join(lines)


def grid(records: Records) -> str:
    """The table of captures drawn at random, and below it who wins how often."""
    tables = [table for table in make_tables(records) if table.by_row]
    if not tables:
        return "Too few captures have run yet."
    return _body(markdown("", "", tables, origins(records))).partition("\n")[2].strip()


def grid_summary(records: Records) -> str:
    """How `evsplat`, `paper` and the camera's own picture compare where both methods ran."""
    value = metric("standard", "person_mask", "psnr")
    ours, theirs, own = (
        {c: found.mean for c in records.captures if (found := records.figure(row, value, [c]))}
        for row in ("evsplat", "paper", "own_picture")
    )
    gaps = {capture: ours[capture] - theirs[capture] for capture in ours if capture in theirs}
    if not gaps:
        return "No capture of the grid has both methods yet."
    drawn = records.plan.suite.draw
    total = drawn.captures if drawn else len(gaps)
    ran = f"the {len(gaps)} of {total}" if len(gaps) < total else f"all {total}"
    of_ours, of_theirs = ([of[capture] for capture in gaps] for of in (ours, theirs))
    least = min(gaps, key=lambda capture: gaps[capture])
    closer = [own[capture] > ours[capture] for capture in gaps if capture in own]
    return (
        f"On {ran} captures drawn at random that both have run on, person's pixels: "
        f"`evsplat` {fmean(of_ours):.2f} dB in the mean and {min(of_ours):.2f} at worst, "
        f"`paper` {fmean(of_theirs):.2f} and {min(of_theirs):.2f}; `evsplat` is ahead on "
        f"{sum(gap > 0 for gap in gaps.values())} of {len(gaps)}, by {gaps[least]:+.2f} dB where "
        f"by least ({least}). The picture that the camera took at the test time itself, which no "
        f"method sees, is closer than `evsplat` on {sum(closer)} of {len(closer)}."
    )


def suite_tables(records: Records) -> str:
    """All tables of a suite as the bench itself writes them."""
    intro = LEGEND.format(second="in italics")
    return _body(markdown("", intro, make_tables(records))).replace("## ", "### ")


def _body(page: str) -> str:
    """A Markdown page without its title."""
    return page.partition("\n")[2].strip()


def doubled(records: Records, longer: Records) -> str:
    """Cells that ran longer, behind the same of the table, over the seeds that both ran."""
    lines = [f"| method | steps | {' | '.join(COMPARED)} |", f"|---|---|{'---|' * len(COMPARED)}"]
    half: dict[str, tuple[Records, str]] = {}
    for row in longer.plan.suite.rows:
        name = _STEPS.sub("", row.name)
        pair = _both_ran(half.get(name, (records, name)), (longer, row.name))
        half[name] = longer, row.name
        steps = [of.figure(named, lambda r: r["iteration"], COMPARED) for of, named in pair]
        if None in steps:
            continue
        lengths = " → ".join(f"{found.mean:,.0f}" for found in steps if found)
        texts = [[trio(of, named, capture) for of, named in pair] for capture in COMPARED]
        figures = ["–" if "–" in both else " → ".join(both) for both in texts]
        title = title_of(longer, row, COMPARED)
        lines.append(f"| {title} | {lengths} | {' | '.join(figures)} |")
    return "\n".join(lines)


def _both_ran(*rows: tuple[Records, str]) -> list[tuple[Records, str]]:
    """Rows of records, by the captures and seeds alone that all of them ran on."""
    run = [{(key[0], key[2]) for key in of.by_cell if key[1] == name} for of, name in rows]
    shared = sorted(set.intersection(*run))
    return [
        (replace(of, by_cell={(c, name, s): of.by_cell[c, name, s] for c, s in shared}), name)
        for of, name in rows
    ]


def psnr_of(record: Record) -> str:
    """PSNR of full frame / person crop / person mask."""
    regions = record["protocols"]["standard"]
    values = [regions[region]["psnr"] for region in REGION_TITLES]
    return " / ".join("–" if value is None else f"{value:.2f}" for value in values)


def cells(suites: Sequence[Records]) -> str:
    """Every kept cell with its commit and its record."""
    lines = ["| suite | capture | row | seed | steps | full / crop / mask | CPU minutes | code | |"]
    lines.append("|---|---|---|---:|---:|---|---:|---|---|")
    for records in suites:
        for (capture, row, seed), record in sorted(records.by_cell.items()):
            cpu, suite = record.get("train_cpu_seconds"), records.plan.suite.name
            words = (
                suite,
                capture,
                row,
                str(seed),
                f"{record['iteration']:,}" if record["iteration"] else "–",
                psnr_of(record),
                f"{cpu / 60:.1f}" if cpu else "–",
                (record.get("code") or {}).get("commit", "–"),
                f"[record](results/{suite}/{capture}/{row}/seed{seed}.json)",
            )
            lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines)


def convergence() -> str:
    """Where doubling the steps stops to pay, of the points that are kept."""
    curves = curves_of(read_points(KEPT / "convergence"))
    lines = ["| capture | method | steps | full / crop / mask | |", "|---|---|---:|---|---|"]
    for capture, of_method in curves.items():
        for method, points in of_method.items():
            at = knee(points, GAIN_DB)
            psnr = " / ".join(f"{at[key]:.2f}" for key in _OF_POINT)
            said = "the knee" if at["converged"] else "no knee seen yet: the longest run"
            lines.append(f"| {capture} | {method} | {at['steps']:,} | {psnr} | {said} |")
    return "\n".join(lines) if curves else "No points are kept yet."


def texts() -> dict[str, str]:
    """Every place by its name."""
    stage, drawn = kept_records("stage"), kept_records("grid")
    longer = kept_records(LONGER)
    return {
        "methods": methods(stage, longer),
        "for-users": at_knee(stage, longer),
        "captures": captures(stage),
        "grid": grid(drawn),
        "grid-summary": grid_summary(drawn),
        "stage-tables": suite_tables(_only(stage, COMPARED)),
        "doubled": doubled(stage, longer),
        "cells": cells([stage, longer, drawn]),
        "convergence": convergence(),
    }


def filled(page: str, made: dict[str, str]) -> str:
    """A page with all its places made anew."""
    return _PLACE.sub(lambda found: f"{found[1]}\n{made[found[2]]}\n\n{found[3]}", page)


def main() -> int:
    """Write or check all pages; 1 where one is older than the records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    check = parser.parse_args().check
    made, older = texts(), []
    for name in PAGES:
        path = ROOT / name
        there = path.read_text("utf-8")
        if filled(there, made) != there:
            older.append(name)
            if not check:
                path.write_text(filled(there, made), "utf-8")
    curves = curves_of(read_points(KEPT / "convergence"))
    if curves and not check:
        draw(curves, FIGURE)
    print(f"{'older than the records' if check else 'written'}: {', '.join(older) or 'none'}")
    return int(check and bool(older))


if __name__ == "__main__":
    sys.exit(main())
