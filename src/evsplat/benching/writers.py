"""Bench tables as Markdown, LaTeX (booktabs) and HTML."""

from collections.abc import Sequence
from html import escape

from evsplat.benching.tables import BenchTable, Heading, TableCell
from evsplat.evaluation.tables import latex_text, markdown_table

_ARROWS = {True: "↑", False: "↓", None: ""}
LEGEND = "Best of a column bold, second best {second}. ± is the standard deviation over seeds."


def markdown(title: str, tables: Sequence[BenchTable]) -> str:
    """All tables as one Markdown page."""
    lines = [f"# {title}", "", LEGEND.format(second="in italics"), ""]
    for table in tables:
        lines += [f"## {table.title}", "", table.note, ""]
        head = [
            f"{h.group} {h.title} {_ARROWS[h.higher_is_better]}".strip() for h in table.headings
        ]
        rows = [
            (_markdown_text(name), [_marked(cell, ("{}", "**{}**", "*{}*")) for cell in cells])
            for name, cells in table.rows
        ]
        lines += markdown_table("", [_markdown_text(text) for text in head], rows)
        lines += ["", *(f"- {_markdown_text(note)}" for note in table.footnotes)]
        lines += [""] if table.footnotes else []
    return "\n".join(lines).rstrip() + "\n"


def latex(tables: Sequence[BenchTable]) -> str:
    """All tables as LaTeX ``tabular`` environments."""
    lines: list[str] = []
    for table in tables:
        rules, first = [], 2
        for _, span in table.groups:
            rules.append(rf"\cmidrule(lr){{{first}-{first + span - 1}}}")
            first += span
        groups = [
            rf"\multicolumn{{{span}}}{{c}}{{{latex_text(group)}}}" for group, span in table.groups
        ]
        lines += [
            *(f"% {text}" for text in (table.title, table.note, *table.footnotes)),
            rf"\begin{{tabular}}{{l{'r' * len(table.headings)}}}",
            r"\toprule",
            " & ".join(["", *groups]) + r" \\",
            "".join(rules),
            " & ".join(["", *map(_latex_heading, table.headings)]) + r" \\",
            r"\midrule",
        ]
        for name, cells in table.rows:
            shown = [_marked(cell, ("{}", r"\textbf{{{}}}", r"\underline{{{}}}")) for cell in cells]
            shown = [text.replace("–", "--").replace("±", r"$\pm$") for text in shown]
            lines.append(" & ".join([_latex_name(name), *shown]) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def html(table: BenchTable) -> str:
    """One table as HTML that scrolls sideways on a narrow screen."""
    groups = "".join(f'<th colspan="{span}">{escape(group)}</th>' for group, span in table.groups)
    heads = "".join(
        f"<th>{escape(h.title)} {_ARROWS[h.higher_is_better]}</th>" for h in table.headings
    )
    classes = ("", ' class="best"', ' class="second"')
    rows = "".join(
        f"<tr><th>{escape(name)}</th>"
        + "".join(f"<td{classes[cell.rank]}>{escape(cell.text)}</td>" for cell in cells)
        + "</tr>"
        for name, cells in table.rows
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.footnotes)
    return (
        '<div class="scroll"><table><thead><tr><th class="corner" rowspan="2"></th>'
        f"{groups}</tr><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    ) + (f'<ul class="note">{notes}</ul>' if notes else "")


def _marked(cell: TableCell, forms: tuple[str, str, str]) -> str:
    return forms[cell.rank].format(cell.text)


def _latex_heading(heading: Heading) -> str:
    arrows = {True: r"$\uparrow$", False: r"$\downarrow$", None: ""}
    return latex_text(heading.title) + arrows[heading.higher_is_better]


def _latex_name(name: str) -> str:
    return latex_text(name).replace("†", r"$^\dagger$").replace("·", r"$\cdot$")


def _markdown_text(text: str) -> str:
    escaped = "".join("\\" + c if c in "|*_`<" else c for c in text)
    return " ".join(escaped.split())
