"""Tables of a bench in the layout of the paper's: what every column holds and who is best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from evsplat.benching.figures import Figure, Record, Records, metric
from evsplat.benching.suite import PublishedTable, SuiteRow
from evsplat.capture.policy import STRICT_TERMS, policy_of
from evsplat.evaluation.protocols import PROTOCOLS
from evsplat.evaluation.tables import METRIC_TITLES, REGION_TITLES, Column
from evsplat.methods import NOMINAL_ITERATIONS

Read = Callable[[SuiteRow], Figure | None]
_PUBLISHED = "published"


@dataclass(frozen=True)
class TableCell:
    """A cell as it is printed."""

    text: str
    rank: int = 0
    """1: best of the column, 2: second best, 0: neither."""


@dataclass(frozen=True)
class Heading:
    """Head of a column."""

    group: str
    title: str
    decimals: int
    higher_is_better: bool | None
    """None: there is no better."""


@dataclass(frozen=True)
class BenchTable:
    """One table, ready to be written in any language."""

    name: str
    title: str
    note: str
    headings: tuple[Heading, ...]
    rows: tuple[tuple[str, tuple[TableCell, ...]], ...]
    footnotes: tuple[str, ...] = field(default=())

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Titles over neighbouring columns, and how many each spans."""
        spans: list[tuple[str, int]] = []
        for heading in self.headings:
            if spans and spans[-1][0] == heading.group:
                spans[-1] = (heading.group, spans[-1][1] + 1)
            else:
                spans.append((heading.group, 1))
        return spans


@dataclass(frozen=True)
class _Column:
    heading: Heading
    read: Read


def make_tables(records: Records) -> list[BenchTable]:
    """The published layout where the suite has one, then means and single captures."""
    published = records.plan.suite.published
    shared = [name for name in records.captures if published and name in published.captures]
    tables = [_published(records, published, shared)] if published and shared else []
    tables.append(_means(records, "standard"))
    if len(records.captures) > 1:
        tables.append(_per_capture(records))
    tables.append(_means(records, "avatar-compat"))
    notes = _footnotes(records)
    return [replace(tables[0], footnotes=(*tables[0].footnotes, *notes)), *tables[1:]]


def _published(records: Records, published: PublishedTable, shared: list[str]) -> BenchTable:
    """Figures of the publication beside ours of the same captures, full frame first."""
    protocol = "avatar-compat"
    columns = [
        _Column(
            Heading(_PUBLISHED, title, decimals, higher), partial(_published_mean, key, published)
        )
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
    table = _table(records, "published", "Beside the published figures", protocol, columns, shared)
    return replace(table, footnotes=tuple(notes))


def _published_mean(key: str, published: PublishedTable, row: SuiteRow) -> Figure | None:
    if row.published is None:
        return None
    return Figure(getattr(row.published, key), None, len(published.captures))


def _means(records: Records, protocol: str) -> BenchTable:
    columns = _metric_columns(records, protocol, records.captures, tuple(METRIC_TITLES))
    # All three are None for rows that do not train.
    training: dict[tuple[str, int], Callable[[Record], float | None]] = {
        ("minutes", 1): lambda r: r["train_seconds"] and r["train_seconds"] / 60,
        ("steps", 0): lambda r: r["iteration"],
        ("Gaussians", 0): lambda r: r["gaussians"] and sum(r["gaussians"].values()),
    }
    columns += [
        _Column(Heading("training", title, decimals, None), _reader(records, value))
        for (title, decimals), value in training.items()
    ]
    count = len(records.captures)
    over = f"Mean over {count} captures" if count != 1 else records.captures[0]
    title = f"{over}, protocol {protocol}"
    return _table(records, f"means-{protocol}", title, protocol, columns, records.captures)


def _per_capture(records: Records) -> BenchTable:
    columns = [
        _Column(
            Heading(capture, REGION_TITLES[region], 2, True),
            _reader(records, metric("standard", region, "psnr"), [capture]),
        )
        for capture in records.captures
        for region in REGION_TITLES
    ]
    title = "PSNR of every capture, dB"
    return _table(records, "captures", title, "standard", columns, records.captures[:1])


def _metric_columns(
    records: Records,
    protocol: str,
    captures: Sequence[str],
    names: Sequence[str],
    *,
    keep: bool = False,
) -> list[_Column]:
    """Columns of all regions; those without any figure are left out unless ``keep``."""
    columns = []
    for region, region_title in REGION_TITLES.items():
        for name in names:
            shape = Column(region, name)
            heading = Heading(
                region_title, METRIC_TITLES[name], shape.decimals, shape.higher_is_better
            )
            column = _Column(heading, _reader(records, metric(protocol, region, name), captures))
            known = any(column.read(row) is not None for row in records.plan.suite.rows)
            if known or (keep and region == "full"):
                columns.append(column)
    return columns


def _reader(
    records: Records, value: Callable[[Record], float | None], captures: Sequence[str] | None = None
) -> Read:
    where = records.captures if captures is None else captures
    return lambda row: records.figure(row.name, value, where)


def _table(
    records: Records,
    name: str,
    title: str,
    protocol: str,
    columns: Sequence[_Column],
    captures: Sequence[str],
) -> BenchTable:
    """Read, rank and format; a row that lacks some of ``captures`` does not compete."""
    rows = records.plan.suite.rows
    complete = {row.name: sum(bool(records.of(c, row.name)) for c in captures) for row in rows}
    shown: dict[str, list[TableCell]] = {row.name: [] for row in rows}
    for column in columns:
        figures = {row.name: column.read(row) for row in rows}
        competing = {
            key: round(figure.mean, column.heading.decimals)
            for key, figure in figures.items()
            if figure is not None
            and (complete[key] == len(captures) or column.heading.group == _PUBLISHED)
        }
        for key, figure in figures.items():
            rank = _rank(competing, key, column.heading.higher_is_better)
            shown[key].append(TableCell(_text(figure, column.heading.decimals), rank))
    titled = []
    for row in rows:
        title_of_row = "; ".join([row.label, *_own_terms(records, row, captures)])
        if 0 < complete[row.name] < len(captures):
            title_of_row += f" ({complete[row.name]} of {len(captures)} captures)"
        elif not complete[row.name]:
            failed = any(name == row.name for name, _ in records.failures())
            title_of_row += " (failed)" if failed else " (not run)"
        titled.append((title_of_row, tuple(shown[row.name])))
    note = next(p.summary for p in PROTOCOLS if p.name == protocol)
    headings = tuple(column.heading for column in columns)
    caption = f"{protocol}: {note}. {_terms(records, captures)}"
    return BenchTable(name, title, caption, headings, tuple(titled))


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
    if shown:
        sentences.append(f"Test frames: {' + '.join(shown)}.")
    return " ".join(sentences)


def _own_terms(records: Records, row: SuiteRow, captures: Sequence[str]) -> list[str]:
    """Departures of a row's policy from the strict terms."""
    policies = [policy_of(r) for c in captures for r in records.of(c, row.name)]
    return list(dict.fromkeys(text for p in policies if p for text in p.departures))


def _rank(competing: dict[str, float], row: str, higher: bool | None) -> int:
    """Rank by what is printed; equal values share one."""
    if higher is None or row not in competing:
        return 0
    values = sorted(set(competing.values()), reverse=higher)
    place = values.index(competing[row]) + 1
    return place if place <= 2 and len(competing) > 1 else 0


def _text(figure: Figure | None, decimals: int) -> str:
    if figure is None:
        return "–"
    text = f"{figure.mean:.{decimals}f}"
    return text if figure.spread is None else f"{text} ± {figure.spread:.{decimals}f}"


def _footnotes(records: Records) -> list[str]:
    """Reasons why something is not in the tables."""
    titles = {row.name: row.label for row in records.plan.suite.rows}
    notes = [
        f"{titles[row]} failed on {', '.join(captures)}: {reason}"
        for (row, reason), captures in records.failures().items()
    ]
    notes += list(records.plan.missing.values())
    left = len(records.plan.cells) - len(records.by_cell)
    if left:
        notes.append(f"{left} of {len(records.plan.cells)} cells have not been run yet.")
    weights: dict[str, dict[str, Any]] = {}
    for record in records.by_cell.values():
        weights |= record.get("weights", {})
    return notes + [entry["reason"] for entry in weights.values() if entry["sha256"] is None]
