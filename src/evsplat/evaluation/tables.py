"""The figures as Markdown and LaTeX tables, one per protocol, trivial rows included."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evsplat.capture.policy import policy_of
from evsplat.evaluation.splits import SplitWords, count_of, name_of, split_of, words_of
from evsplat.files import write_text

ROW_TITLES = {
    "on_median_background": "the same person on the median background",
    "median_background": "median background (trivial)",
    "nearest_frame": "nearest training frame (trivial)",
}
REGION_TITLES = {"full": "full frame", "person_crop": "person crop", "person_mask": "person mask"}


@dataclass(frozen=True)
class Column:
    """One figure of one region."""

    region: str
    metric: str

    @property
    def higher_is_better(self) -> bool:
        """PSNR and SSIM grow with likeness, distances shrink."""
        return self.metric in ("psnr", "ssim")

    @property
    def arrow(self) -> str:
        """The direction of better values."""
        return "↑" if self.higher_is_better else "↓"

    @property
    def decimals(self) -> int:
        """Digits after the point."""
        return 2 if self.metric == "psnr" else 4


METRIC_TITLES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS-Alex",
    "lpips_vgg": "LPIPS-VGG",
    "st_lpips": "ST-LPIPS",
}


@dataclass(frozen=True)
class Table:
    """Rows of one protocol; columns without any figure are left out."""

    protocol: str
    note: str
    columns: tuple[Column, ...]
    rows: dict[str, dict[str, dict[str, float | None]]]
    """Row key (the method's name, trivial rows, blurry_input) -> region -> metric -> value."""
    method: str
    words: SplitWords
    """Words for the frames that were measured."""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Titles of the regions over neighbouring columns, and how many each spans."""
        spans = {r: sum(column.region == r for column in self.columns) for r in REGION_TITLES}
        return [(REGION_TITLES[region], span) for region, span in spans.items() if span]

    def value(self, row: str, column: Column) -> float | None:
        """Value of one cell; None where nothing was measured."""
        return self.rows[row][column.region][column.metric]

    def text(self, row: str, column: Column) -> str:
        """One cell, formatted; a dash where nothing was measured."""
        value = self.value(row, column)
        return "–" if value is None else f"{value:.{column.decimals}f}"

    def is_best(self, row: str, column: Column) -> bool:
        """True for the best row of a column as it is printed; the blurry input does not compete."""
        if row == "blurry_input" or self.value(row, column) is None:
            return False
        shown = [
            round(value, column.decimals)
            for name in self.rows
            if name != "blurry_input" and (value := self.value(name, column)) is not None
        ]
        best = max(shown) if column.higher_is_better else min(shown)
        return float(self.text(row, column)) == best

    def cells(self, row: str, best: str) -> list[str]:
        """Texts of a row; ``best`` is the form of the best of a column."""
        return [
            best.format(self.text(row, column))
            if self.is_best(row, column)
            else self.text(row, column)
            for column in self.columns
        ]

    def title(self, row: str) -> str:
        """Title of a row for readers."""
        own = {"blurry_input": self.words.blurry_input}
        return (ROW_TITLES | own).get(row, row)


def tables_of(metrics: dict[str, Any]) -> Iterator[Table]:
    """One table per protocol, `standard` first; with other rows where they were measured."""
    for protocol, ours in metrics["protocols"].items():
        if protocol == "standard":
            others = {**composited(metrics), **metrics.get("trivial", {})}
            if "blurry_input" in metrics:
                others["blurry_input"] = metrics["blurry_input"]
        else:
            others = metrics.get("compat_rows", {}).get(protocol, {})
        rows = {metrics["method"]: ours, **others}
        columns = tuple(
            Column(region, metric)
            for region in REGION_TITLES
            for metric in METRIC_TITLES
            if any(row[region][metric] is not None for row in rows.values())
        )
        note = metrics["protocol_notes"][protocol]
        yield Table(protocol, note, columns, rows, metrics["method"], words_of(metrics))


def composited(metrics: dict[str, Any]) -> dict[str, Any]:
    """The extra row of a method without scene under protocol standard; empty for all others."""
    if "composited" not in metrics:
        return {}
    return {"on_median_background": metrics["composited"]["standard"]}


def terms(metrics: dict[str, Any]) -> str:
    """Terms of the run: one sentence on what training saw."""
    policy = policy_of(metrics)
    return "The run does not tell what training saw." if policy is None else policy.sentence


def missing_networks(metrics: dict[str, Any]) -> list[str]:
    """One sentence per network distance without weights."""
    return [entry["reason"] for entry in metrics["weights"].values() if entry["sha256"] is None]


def write_tables(folder: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.md and metrics.tex, or those of training frames (metrics_train.md ...)."""
    split = split_of(metrics)
    write_text(folder / name_of("metrics", split, ".md"), markdown(metrics))
    write_text(folder / name_of("metrics", split, ".tex"), latex(metrics))


def markdown(metrics: dict[str, Any]) -> str:
    """All tables as Markdown; the best of each column in bold."""
    lines = [f"# {metrics['method']} on {metrics['capture']}", ""]
    count = count_of(metrics)
    frames = words_of(metrics).title.lower()
    means = f"Means over {count} {frames} against the sharp truth. " if count else ""
    lines += [f"{means}{terms(metrics)}", ""]
    for table in tables_of(metrics) if count else ():
        lines += [f"## Protocol `{table.protocol}`", "", f"{table.note}.", ""]
        head = [
            f"{REGION_TITLES[c.region]} {METRIC_TITLES[c.metric]} {c.arrow}" for c in table.columns
        ]
        rows = [(table.title(row), table.cells(row, "**{}**")) for row in table.rows]
        lines += [*markdown_table("", head, rows), ""]
    lines += _novel_markdown(metrics)
    lines += [f"- {remark}" for remark in metrics.get("remarks", ())]
    lines += [f"- {reason}" for reason in missing_networks(metrics)]
    return "\n".join(lines).rstrip() + "\n"


def _novel_markdown(metrics: dict[str, Any]) -> list[str]:
    if not metrics["novel_views"]:
        return []
    head = ("full PSNR", "full SSIM", "person crop PSNR", "person crop SSIM")
    rows = []
    for camera, regions in metrics["novel_views"].items():
        cells = [
            "–" if (value := regions[region][metric]) is None else f"{value:.{digits}f}"
            for region in ("full", "person_crop")
            for metric, digits in (("psnr", 2), ("ssim", 4))
        ]
        rows.append((camera, cells))
    title = "## Novel views, protocol `standard`"
    return [title, "", *markdown_table("camera", head, rows), ""]


def latex(metrics: dict[str, Any]) -> str:
    """All tables as LaTeX (booktabs)."""
    lines = [f"% {words_of(metrics).title}. {terms(metrics)}"]
    for table in tables_of(metrics) if count_of(metrics) else ():
        groups = [rf"\multicolumn{{{span}}}{{c}}{{{title}}}" for title, span in table.groups]
        names = [
            METRIC_TITLES[c.metric] + (r"$\uparrow$" if c.higher_is_better else r"$\downarrow$")
            for c in table.columns
        ]
        lines += [
            f"% protocol {table.protocol}: {table.note}",
            rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
            r"\toprule",
            " & ".join([f"protocol {table.protocol}", *groups]) + r" \\",
            " & ".join(["", *names]) + r" \\",
            r"\midrule",
        ]
        for row in table.rows:
            cells = [cell.replace("–", "--") for cell in table.cells(row, r"\textbf{{{}}}")]
            lines.append(" & ".join([latex_text(table.title(row)), *cells]) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def markdown_table(
    corner: str, head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]
) -> list[str]:
    """Lines of a Markdown table; each row has a title and its cells."""
    lines = ["| " + " | ".join([title, *cells]) + " |" for title, cells in ((corner, head), *rows)]
    return [lines[0], "|" + "|".join(["---", *["---:"] * len(head)]) + "|", *lines[1:]]


_LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
}


def latex_text(text: str) -> str:
    """``text`` with everything escaped that LaTeX would take for its own."""
    return "".join(_LATEX_SPECIAL.get(character, character) for character in text)
