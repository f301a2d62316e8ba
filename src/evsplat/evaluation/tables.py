"""Tables in Markdown, LaTeX (booktabs) and HTML; those of a run's figures, one per protocol."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from evsplat.capture.policy import terms_of
from evsplat.evaluation.splits import count_of, counted_frames, name_of, split_of, words_of
from evsplat.files import write_text

ROW_TITLES = {
    "on_median_background": "the same person on the median background",
    "median_background": "median background (trivial)",
    "nearest_frame": "nearest training frame (trivial)",
}
REGION_TITLES = {"full": "full frame", "person_crop": "person crop", "person_mask": "person mask"}
METRIC_TITLES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS-Alex",
    "lpips_vgg": "LPIPS-VGG",
    "st_lpips": "ST-LPIPS",
}
LEGEND = "Best of a column bold, second best {second}."
_ARROWS = {True: "↑", False: "↓", None: ""}
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
    # In the encoding that LaTeX begins with these three are other characters.
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"},
    **{"–": "--", "±": r"$\pm$", "†": r"$^\dagger$", "·": r"$\cdot$"},
    **{"↑": r"$\uparrow$", "↓": r"$\downarrow$"},
}


@dataclass(frozen=True)
class Heading:
    """Head of a column."""

    group: str
    title: str
    decimals: int
    higher_is_better: bool | None
    """None: there is no better."""

    @classmethod
    def of(cls, region: str, metric: str) -> "Heading":
        """Head of a metric in a region; PSNR and SSIM grow with likeness, distances shrink."""
        decimals, higher = (2 if metric == "psnr" else 4), metric in ("psnr", "ssim")
        return cls(REGION_TITLES[region], METRIC_TITLES[metric], decimals, higher)


@dataclass(frozen=True)
class Figure:
    """Number in a cell."""

    mean: float
    spread: float | None = None
    """Standard deviation of the mean over seeds; None with one seed."""
    competes: bool = True
    """Whether it may be the best of its column."""


@dataclass(frozen=True)
class Row:
    """A line of a table; None where there is no figure."""

    title: str
    figures: tuple[Figure | None, ...]
    kind: str = ""
    """Its class in HTML."""


@dataclass(frozen=True)
class Table:
    """One table, to be written in any language."""

    title: str
    note: str
    headings: tuple[Heading, ...]
    rows: tuple[Row, ...]
    footnotes: tuple[str, ...] = ()
    by_row: bool = False
    """Whether the figures of a row compete with each other, rather than those of a column."""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Titles over neighbouring columns, and how many each spans."""
        groups = groupby(self.headings, key=lambda heading: heading.group)
        return [(group, len(list(headings))) for group, headings in groups]

    def rank(self, row: Row, column: int) -> int:
        """1: best of the column as it is printed, 2: second best, 0: neither; equal ones share.

        Of its row where the table is `by_row`.
        """
        heading, figure = self.headings[column], row.figures[column]
        figures = row.figures if self.by_row else [o.figures[column] for o in self.rows]
        competing = [round(f.mean, heading.decimals) for f in figures if f and f.competes]
        better = heading.higher_is_better
        if better is None or figure is None or not figure.competes or len(competing) < 2:
            return 0
        ranked = sorted(set(competing), reverse=better)
        place = ranked.index(round(figure.mean, heading.decimals)) + 1
        return place if place <= 2 else 0

    def cells(
        self, row: Row, forms: Sequence[str], escaped: Callable[[str], str] = str
    ) -> list[str]:
        """Texts of a row, in the form of their rank."""
        cells = []
        for column, (heading, figure) in enumerate(zip(self.headings, row.figures, strict=True)):
            text = "–" if figure is None else f"{figure.mean:.{heading.decimals}f}"
            if figure is not None and figure.spread is not None:
                text += f" ± {figure.spread:.{heading.decimals}f}"
            cells.append(forms[self.rank(row, column)].format(escaped(text)))
        return cells


def tables_of(metrics: dict[str, Any]) -> list[Table]:
    """One table per protocol, `standard` first; with other rows where they were measured."""
    titles = ROW_TITLES | {"blurry_input": words_of(metrics).blurry_input}
    tables = []
    for protocol, ours in metrics["protocols"].items():
        if protocol == "standard":
            others = {**composited(metrics), **metrics.get("trivial", {})}
            if "blurry_input" in metrics:
                others["blurry_input"] = metrics["blurry_input"]
        else:
            others = metrics.get("compat_rows", {}).get(protocol, {})
        rows = {metrics["method"]: ours, **others}
        note = f"{metrics['protocol_notes'][protocol]}."
        gaps = _gaps(metrics, protocol, rows, titles)
        tables.append(_table(f"Protocol {protocol}", note, rows, titles, metrics["method"], gaps))
    return tables


def standard_gaps(metrics: dict[str, Any]) -> tuple[str, ...]:
    """A sentence for each row of protocol `standard` that has no figure, with the reason."""
    rows = {metrics["method"]: metrics["protocols"]["standard"]}
    rows |= composited(metrics) | metrics.get("trivial", {})
    return _gaps(metrics, "standard", rows, {})


def reason_of_gap(metrics: dict[str, Any], place: str) -> str | None:
    """Why a row of metrics.json, or of a bench's cell, has no figure; None where it has one.

    ``place`` is its path of keys. None as well where nothing tells.
    """
    row: Any = metrics
    for key in place.split("."):
        row = row[key]
    if any(value is not None for region in row.values() for value in region.values()):
        return None
    reason: str | None = metrics.get("reasons", {}).get(f"{place}.full.psnr")
    return reason


def _gaps(
    metrics: dict[str, Any], protocol: str, rows: Iterable[str], titles: dict[str, str]
) -> tuple[str, ...]:
    """A sentence for each of ``rows`` that has no figure; those of one reason share it."""
    found: dict[str, list[str]] = {}
    for name in rows:
        if name == "blurry_input":
            continue  # the camera's pictures are the truth where it has none
        place = f"compat_rows.{protocol}.{name}"
        if name == metrics["method"]:
            place = f"protocols.{protocol}"
        elif protocol == "standard":
            own = name in composited(metrics)
            place = f"composited.{protocol}" if own else f"trivial.{name}"
        if reason := reason_of_gap(metrics, place):
            found.setdefault(reason, []).append(titles.get(name, name))
    return tuple(f"{', '.join(names)}: {why.rstrip('.')}." for why, names in found.items())


def _table(
    title: str,
    note: str,
    rows: dict[str, Any],
    titles: dict[str, str],
    method: str | None = None,
    footnotes: tuple[str, ...] = (),
) -> Table:
    """Rows of region -> metric -> value; columns without any figure are left out."""
    columns = [
        (region, metric)
        for region in REGION_TITLES
        for metric in METRIC_TITLES
        if any(row.get(region, {}).get(metric) is not None for row in rows.values())
    ]
    lines = []
    for name, row in rows.items():
        competes = method is not None and name != "blurry_input"
        values = [row[region][metric] for region, metric in columns]
        if name == "blurry_input" and not any(value is not None for value in values):
            continue  # the camera's pictures are the truth itself
        figures = (None if v is None else Figure(v, competes=competes) for v in values)
        kind = "aside" if name == "blurry_input" else "ours" if name == method else "other"
        lines.append(Row(titles.get(name, name), tuple(figures), kind))
    headings = tuple(Heading.of(*column) for column in columns)
    return Table(title, note, headings, tuple(lines), footnotes)


def composited(metrics: dict[str, Any]) -> dict[str, Any]:
    """The extra row of a method without scene under protocol standard; empty for all others."""
    if "composited" not in metrics:
        return {}
    return {"on_median_background": metrics["composited"]["standard"]}


def without_truth(metrics: dict[str, Any]) -> str | None:
    """A sentence where no frame that was measured has a sharp picture; None where one has."""
    rows = [metrics["protocols"]["standard"], metrics.get("blurry_input") or {}]
    if not count_of(metrics) or any(row.get("full", {}).get("psnr") is not None for row in rows):
        return None
    return f"Of {counted_frames(metrics)} none has a sharp picture to be compared with."


def input_is_truth(metrics: dict[str, Any]) -> bool:
    """Whether the camera's own pictures are the sharp truth, as those of sharp data sets are."""
    ours, own = metrics["protocols"]["standard"], metrics.get("blurry_input")
    return own is not None and ours["full"]["psnr"] is not None and own["full"]["psnr"] is None


def terms(metrics: dict[str, Any]) -> str:
    """Terms of a run, or of a bench's cell: a sentence on what training saw, and one on poses that
    were not given.
    """
    seen = "Nothing tells what training saw."
    if (known := terms_of(metrics)) is not None:
        seen = known.sentence(metrics["frames"]["test"])
    return " ".join(filter(None, (seen, metrics.get("poses"))))


def missing_networks(metrics: dict[str, Any]) -> list[str]:
    """One sentence per network distance without weights; none where nothing is to be compared."""
    if without_truth(metrics) and not metrics.get("novel_views"):
        return []
    return [entry["reason"] for entry in metrics["weights"].values() if entry["sha256"] is None]


def write_tables(folder: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.md and metrics.tex, or those of training frames (metrics_train.md ...)."""
    count, words, split = count_of(metrics), words_of(metrics), split_of(metrics)
    why = without_truth(metrics)
    tables = tables_of(metrics) if count and not why else []
    if views := metrics["novel_views"]:
        tables.append(_table("Novel views", "Protocol standard.", views, {}))
    means = f"Means over {counted_frames(metrics)} against the sharp truth." if count else None
    legend = LEGEND.format(second="in italics") if tables else None
    intro = " ".join(filter(None, (why or means, terms(metrics), legend)))
    title = f"{metrics['method']} on {metrics['capture']}"
    notes = [*metrics.get("remarks", ()), *missing_networks(metrics)]
    page = markdown(title, intro, tables, notes)
    write_text(folder / name_of("metrics", split, ".md"), page)
    page = f"% {words.title}. {terms(metrics)}\n{latex(tables)}"
    write_text(folder / name_of("metrics", split, ".tex"), page)


def markdown(title: str, intro: str, tables: Iterable[Table], notes: Sequence[str] = ()) -> str:
    """All tables as one Markdown page, with ``notes`` at its end."""
    lines = [f"# {_markdown_text(title)}", "", intro, ""]
    for table in tables:
        lines += [f"## {_markdown_text(table.title)}", "", table.note, ""]
        head = [
            _markdown_text(f"{h.group} {h.title} {_ARROWS[h.higher_is_better]}".strip())
            for h in table.headings
        ]
        rows = [["", *head], ["---", *["---:"] * len(head)]]
        for row in table.rows:
            rows.append([_markdown_text(row.title), *table.cells(row, ("{}", "**{}**", "*{}*"))])
        lines += [f"| {' | '.join(row)} |" for row in rows]
        lines += ["", *_markdown_list(table.footnotes)]
    return "\n".join([*lines, *_markdown_list(notes)]).rstrip() + "\n"


def _markdown_list(items: Sequence[str]) -> list[str]:
    return [*(f"- {_markdown_text(item)}" for item in items), ""] if items else []


def _markdown_text(text: str) -> str:
    escaped = "".join("\\" + c if c in "|*_`<[" else c for c in text)
    return " ".join(escaped.split())


def latex(tables: Sequence[Table]) -> str:
    """All tables as LaTeX ``tabular`` environments."""
    lines: list[str] = []
    for table in tables:
        rules, groups, first = [], [], 2
        for group, span in table.groups:
            rules.append(rf"\cmidrule(lr){{{first}-{first + span - 1}}}")
            groups.append(rf"\multicolumn{{{span}}}{{c}}{{{_latex_text(group)}}}")
            first += span
        heads = [_latex_text(h.title + _ARROWS[h.higher_is_better]) for h in table.headings]
        forms = ("{}", r"\textbf{{{}}}", r"\underline{{{}}}")
        lines += [
            *(f"% {text}" for text in (table.title, table.note, *table.footnotes)),
            rf"\begin{{tabular}}{{l{'r' * len(table.headings)}}}",
            r"\toprule",
            " & ".join(["", *groups]) + r" \\",
            "".join(rules),
            " & ".join(["", *heads]) + r" \\",
            r"\midrule",
        ]
        for row in table.rows:
            title = _latex_text(row.title)
            if title.startswith(("[", "*")):
                title = f"{{}}{title}"  # behind the end of a row these would be its arguments
            cells = [title, *table.cells(row, forms, _latex_text)]
            lines.append(" & ".join(cells) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def _latex_text(text: str) -> str:
    """``text`` with everything escaped that LaTeX would take for its own."""
    return "".join(_LATEX.get(character, character) for character in text)


def html(table: Table, corner: str = "") -> str:
    """One table as HTML that scrolls sideways on a narrow screen."""
    groups = "".join(
        f'<th colspan="{span}" scope="colgroup">{escape(group)}</th>'
        for group, span in table.groups
    )
    heads = "".join(
        f'<th scope="col">{escape(h.title)}&thinsp;{_ARROWS[h.higher_is_better]}</th>'
        for h in table.headings
    )
    forms = ("<td>{}</td>", '<td class="best">{}</td>', '<td class="second">{}</td>')
    rows = "".join(
        f'<tr class="{row.kind}"><th scope="row">{escape(row.title)}</th>'
        f"{''.join(table.cells(row, forms, escape))}</tr>"
        for row in table.rows
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.footnotes)
    return (
        '<div class="scroll"><table><thead><tr>'
        f'<th rowspan="2" class="corner">{escape(corner)}</th>{groups}</tr>'
        f"<tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    ) + (f'<ul class="note">{notes}</ul>' if notes else "")
