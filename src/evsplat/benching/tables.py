"""Tables of a bench in the layout of the paper's: what every column holds."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

from evsplat.benching.figures import Record, Records, metric
from evsplat.benching.given_pictures import OWN_PICTURE
from evsplat.benching.suite import PublishedTable, SuiteRow
from evsplat.capture.policy import STRICT_TERMS, terms_of
from evsplat.evaluation.protocols import PROTOCOLS
from evsplat.evaluation.tables import (
    METRIC_TITLES,
    REGION_TITLES,
    Figure,
    Heading,
    Row,
    Table,
    reason_of_gap,
)
from evsplat.methods import NOMINAL_ITERATIONS, TRAINABLE
from evsplat.wording import counted

Column = tuple[Heading, Callable[[SuiteRow], Figure | None]]
"""Its head, and the figure of a row."""
_PUBLISHED = "published"
MOST_CAPTURES_ACROSS = 6
"""Of more captures each has a line of its own, in place of columns."""
SPREAD = "± is the standard deviation over seeds."


def make_tables(records: Records) -> list[Table]:
    """The published layout where the suite has one, then means and single captures."""
    published = records.plan.suite.published
    shared = [name for name in records.captures if published and name in published.captures]
    tables = [_published(records, published, shared)] if published and shared else []
    tables.append(_means(records, "standard"))
    if len(records.captures) > MOST_CAPTURES_ACROSS:
        tables.append(_capture_by_capture(records))
    elif len(records.captures) > 1:
        tables.append(_per_capture(records))
    tables.append(_means(records, "avatar-compat"))
    notes = _footnotes(records)
    return [replace(tables[0], footnotes=(*tables[0].footnotes, *notes)), *tables[1:]]


def _published(records: Records, published: PublishedTable, shared: list[str]) -> Table:
    """Figures of the publication beside ours of the same captures, full frame first."""
    protocol = "avatar-compat"
    columns: list[Column] = [
        (Heading(_PUBLISHED, title, decimals, higher), partial(_published_mean, key))
        for key, title, decimals, higher in (
            ("psnr", "PSNR", 2, True),
            ("ssim", "SSIM", 4, True),
            ("lpips", "LPIPS", 4, False),
        )
    ]
    names = ("psnr", "ssim", "lpips_vgg")
    columns += _metric_columns(records, protocol, shared, names, keep=True)
    missing = [name for name in published.captures if name not in shared]
    notes = [f"Published: {published.title}; its settings of SSIM and LPIPS are not stated."]
    if missing:
        notes.append(
            f"Ours covers {len(shared)} of the {len(published.captures)} published captures; "
            f"missing: {', '.join(missing)}."
        )
    table = _table(records, "Beside the published figures", protocol, columns, shared)
    return replace(table, footnotes=tuple(notes))


def _published_mean(key: str, row: SuiteRow) -> Figure | None:
    return None if row.published is None else Figure(getattr(row.published, key))


def _means(records: Records, protocol: str) -> Table:
    columns = _metric_columns(records, protocol, records.captures, tuple(METRIC_TITLES))
    # All three are None for rows that do not train.
    training: dict[tuple[str, int], Callable[[Record], float | None]] = {
        ("minutes", 1): lambda r: r["train_seconds"] and r["train_seconds"] / 60,
        # Of the processor, which other work beside it lengthens little.
        ("CPU minutes", 1): lambda r: r.get("train_cpu_seconds") and r["train_cpu_seconds"] / 60,
        ("steps", 0): lambda r: r["iteration"],
        ("Gaussians", 0): lambda r: r["gaussians"] and sum(r["gaussians"].values()),
    }
    columns += [
        (Heading("training", title, decimals, None), _reader(records, value, records.captures))
        for (title, decimals), value in training.items()
    ]
    count = len(records.captures)
    over = f"Mean over {count} captures" if count != 1 else records.captures[0]
    title = f"{over}, protocol {protocol}"
    return _table(records, title, protocol, columns, records.captures)


def _per_capture(records: Records) -> Table:
    columns = [
        (
            Heading(capture, REGION_TITLES[region], 2, True),
            _reader(records, metric("standard", region, "psnr"), [capture]),
        )
        for capture in records.captures
        for region in REGION_TITLES
    ]
    title = "PSNR of every capture, dB"
    return _table(records, title, "standard", columns, records.captures, apart=True)


def _capture_by_capture(records: Records) -> Table:
    """PSNR of the person's pixels: a line per capture, a column per row of the suite.

    Below it, of the captures that a row has: mean, worst, and how many it is the best on.
    """
    rows, region = records.plan.suite.rows, "person_mask"
    value = metric("standard", region, "psnr")
    found = {c: [records.figure(row.name, value, [c]) for row in rows] for c in records.captures}
    lines = [
        Row(
            capture,
            tuple(_competing(row, figure) for row, figure in zip(rows, figures, strict=True)),
        )
        for capture, figures in found.items()
    ]
    headings = tuple(Heading("", row.label, 2, True) for row in rows)
    table = Table(
        "PSNR of the person's pixels on every capture, dB",
        f"standard. {_terms(records, records.captures)}",
        headings,
        tuple(lines),
        by_row=True,
    )
    notes = []
    for column, row in enumerate(rows):
        known = {c: f.mean for c, figures in found.items() if (f := figures[column]) is not None}
        if not known:
            continue
        worst = min(known, key=lambda capture: known[capture])
        note = f"{row.label}: mean {fmean(known.values()):.2f}, worst {known[worst]:.2f} ({worst})"
        if row.method != OWN_PICTURE:
            best = sum(table.rank(line, column) == 1 for line in lines)
            note += f", best on {best} of {len(known)} captures"
        notes.append(f"{note}.")
    return replace(table, footnotes=tuple(notes))


def _metric_columns(
    records: Records,
    protocol: str,
    captures: Sequence[str],
    names: Sequence[str],
    *,
    keep: bool = False,
) -> list[Column]:
    """Columns of all regions; those without any figure are left out unless ``keep``."""
    columns = []
    for region in REGION_TITLES:
        for name in names:
            read = _reader(records, metric(protocol, region, name), captures)
            known = any(read(row) is not None for row in records.plan.suite.rows)
            if known or (keep and region == "full"):
                columns.append((Heading.of(region, name), read))
    return columns


def _reader(
    records: Records, value: Callable[[Record], float | None], captures: Sequence[str]
) -> Callable[[SuiteRow], Figure | None]:
    return lambda row: records.figure(row.name, value, captures)


def _table(
    records: Records,
    title: str,
    protocol: str,
    columns: Sequence[Column],
    captures: Sequence[str],
    *,
    apart: bool = False,
) -> Table:
    """Read all figures; a row that lacks some of ``captures`` does not compete.

    ``apart``: each column is of one capture, on which every row that has it competes.
    """
    rows = []
    for row in records.plan.suite.rows:
        done = sum(bool(records.of(c, row.name)) for c in captures)
        whole = apart or done == len(captures)
        figures = []
        for heading, read in columns:
            published = heading.group == _PUBLISHED
            figures.append(read(row) if published else _competing(row, read(row), whole))
        row_title = title_of(records, row, captures)
        if 0 < done < len(captures):
            row_title += f" ({done} of {len(captures)} captures)"
        elif not done:
            failed = any(name == row.name for name, _ in records.failures())
            row_title += " (failed)" if failed else " (not run)"
        rows.append(Row(row_title, tuple(figures)))
    note = next(p.summary for p in PROTOCOLS if p.name == protocol)
    caption = f"{protocol}: {note}. {_terms(records, captures)}"
    return Table(title, caption, tuple(heading for heading, _ in columns), tuple(rows))


def _competing(row: SuiteRow, figure: Figure | None, whole: bool = True) -> Figure | None:
    """A figure that may be the best if the row is ``whole``; the camera's own never is."""
    return figure and replace(figure, competes=whole and row.method != OWN_PICTURE)


def _terms(records: Records, captures: Sequence[str]) -> str:
    """Terms of every row whose title says nothing else: policy, training steps, test frames."""
    rows = records.plan.suite.rows
    found = [record for c in captures for row in rows for record in records.of(c, row.name)]
    made = sorted({record["iteration"] for record in found if record["iteration"] is not None})
    counts = [
        next((r["frames"]["test"] for row in rows for r in records.of(c, row.name)), None)
        for c in captures
    ]
    shown = [str(count) for count in counts if count is not None]
    sentences = [STRICT_TERMS]
    if made:
        span = f"{made[0]:,}" if len(made) == 1 else f"{made[0]:,} to {made[-1]:,}"
        sentences.append(f"{span} training steps, of schedules made for {NOMINAL_ITERATIONS:,}.")
    if len(shown) > MOST_CAPTURES_ACROSS:
        sentences.append(f"Test frames: {sum(map(int, shown))} of {len(shown)} captures.")
    elif shown:
        sentences.append(f"Test frames: {' + '.join(shown)}.")
    return " ".join(sentences)


def title_of(records: Records, row: SuiteRow, captures: Sequence[str]) -> str:
    """A row's title, and behind it where its policy departs from the strict terms."""
    known = [terms_of(r) for c in captures for r in records.of(c, row.name)]
    departures = dict.fromkeys(text for terms in known if terms for text in terms.departures)
    return "; ".join([row.label, *departures])


def origins(records: Records) -> list[str]:
    """Which commit and machine the records of trained rows are from, oldest commit first."""
    rows: dict[tuple[str, str], list[str]] = {}
    for row, record in _trained(records):
        release = f"release {record.get('evsplat', 'unknown')}"
        code = record.get("code") or {"date": "", "commit": release}
        titles = rows.setdefault((code["date"], code["commit"]), [])
        titles += [row.label] if row.label not in titles else []
    by_code = []
    for (date, commit), titles in sorted(rows.items()):
        whose = f" ({'; '.join(titles)})" if len(rows) > 1 else ""
        by_code.append(commit + (f" of {date}" if date else "") + whose)
    notes = [f"Code: {', '.join(by_code)}."] if by_code else []
    return notes + machines(records)


def machines(records: Records) -> list[str]:
    """Which machines the records of trained rows are from."""
    found = {
        f"{record['machine']}, {_threads(record)}"
        for _, record in _trained(records)
        if record.get("machine")
    }
    return [f"Trained on {text} a cell." for text in sorted(found)]


def _trained(records: Records) -> Iterator[tuple[SuiteRow, Record]]:
    """Records of trained cells, each with its row."""
    for row in records.plan.suite.rows:
        for capture in records.captures:
            yield from ((row, r) for r in records.of(capture, row.name) if r["iteration"])


def _threads(record: Record) -> str:
    return counted(record.get("threads") or 1, "thread")


def _baselines(records: Records) -> list[str]:
    """A sentence per baseline that is not quite what its name stands for, with its rows."""
    titles: dict[str, list[str]] = {}
    for row in records.plan.suite.rows:
        if row.method in TRAINABLE and TRAINABLE[row.method].differs:
            titles.setdefault(row.method, []).append(row.label)
    return [
        f"{'; '.join(labels)}: {TRAINABLE[method].differs} (docs/baselines.md)."
        for method, labels in titles.items()
    ]


def _without_figures(records: Records) -> list[str]:
    """A sentence per row and reason why cells that are over have no figure, with their captures."""
    found: dict[str, dict[str, list[str]]] = {}
    for row in records.plan.suite.rows:
        for capture in records.captures:
            for record in records.of(capture, row.name):
                if reason := reason_of_gap(record, "protocols.standard"):
                    captures = found.setdefault(reason, {}).setdefault(row.label, [])
                    captures += [capture] if capture not in captures else []
    return [
        f"{label} has no figure on {', '.join(captures)}: {reason.rstrip('.')}."
        for reason, rows in found.items()
        for label, captures in rows.items()
    ]


def _footnotes(records: Records) -> list[str]:
    """What titles leave out, and reasons why something is not in the tables."""
    titles = {row.name: row.label for row in records.plan.suite.rows}
    notes = _baselines(records)
    notes += [
        f"{titles[row]} failed on {', '.join(captures)}: {reason}"
        for (row, reason), captures in records.failures().items()
    ]
    notes += _without_figures(records)
    notes += list(records.plan.missing.values())
    left = len(records.plan.cells) - len(records.by_cell)
    if left:
        notes.append(f"{left} of {len(records.plan.cells)} cells have not been run yet.")
    notes += origins(records)
    given = [row.label for row in records.plan.suite.rows if row.pictures]
    if given:
        notes.append(f"{', '.join(given)}: made elsewhere; what training saw is not known.")
    weights: dict[str, dict[str, Any]] = {}
    for record in records.by_cell.values():
        weights |= record.get("weights", {})
    return notes + [entry["reason"] for entry in weights.values() if entry["sha256"] is None]
