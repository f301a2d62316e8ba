"""The figures: large cards, one table per protocol, and what could not be measured."""

from html import escape

from evsplat.evaluation.report.html import folded, section
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.tables import (
    METRIC_TITLES,
    REGION_TITLES,
    Table,
    missing_networks,
    tables_of,
)


def figures(source: Source) -> str:
    """The section with all means."""
    first, *others = tables_of(source.metrics)
    compat = "".join(folded(f"Protocol {table.protocol}", _table(table)) for table in others)
    missing = "".join(f"<li>{escape(reason)}</li>" for reason in missing_networks(source.metrics))
    against = source.metrics["blurry_ground_truth"]["full"]["psnr"]
    blurry = (
        f"<li>Against the blurry pictures instead of the sharp truth (no measure of deblurring): "
        f"{against:.2f} dB full frame.</li>"
        if against is not None
        else ""
    )
    return section(
        "Figures",
        f"Means over {source.metrics['frames']['test']} held-out frames against the sharp picture "
        "at mid-exposure.",
        f'{_cards(first)}{_table(first)}{compat}<ul class="note">{blurry}{missing}</ul>',
    )


def _cards(table: Table) -> str:
    """Large PSNR figures with the distance to the better trivial row."""
    cards = []
    for column in table.columns:
        value = table.value(table.method, column)
        if column.metric != "psnr" or value is None:
            continue
        trivial = [
            other
            for row in table.rows
            if row not in (table.method, "on_median_background", "blurry_input")
            and (other := table.value(row, column)) is not None
        ]
        gain = ""
        if trivial:
            difference = value - max(trivial)
            kind, word = ("up", "above") if difference >= 0 else ("down", "below")
            gain = f'<p class="{kind}">{abs(difference):.2f} dB {word} the best trivial row</p>'
        cards.append(
            f'<div class="card"><p>PSNR, {REGION_TITLES[column.region]}</p>'
            f'<p class="big">{value:.2f}<small> dB</small></p>{gain}</div>'
        )
    return f'<div class="cards">{"".join(cards)}</div>'


def _table(table: Table) -> str:
    groups = "".join(
        f'<th colspan="{span}" scope="colgroup">{title}</th>'
        for region, title in REGION_TITLES.items()
        if (span := sum(column.region == region for column in table.columns))
    )
    names = "".join(
        f'<th scope="col">{METRIC_TITLES[c.metric]}&thinsp;{c.arrow}</th>' for c in table.columns
    )
    rows = []
    for row in table.rows:
        cells = "".join(
            f"<td{' class=best' if table.is_best(row, c) else ''}>{table.text(row, c)}</td>"
            for c in table.columns
        )
        kind = "ours" if row == table.method else "other"
        if row == "blurry_input":
            kind = "aside"
        rows.append(
            f'<tr class="{kind}"><th scope="row">{escape(table.title(row))}</th>{cells}</tr>'
        )
    return (
        f'<div class="scroll"><table><thead><tr><th rowspan="2" class="corner">protocol '
        f"<code>{escape(table.protocol)}</code></th>{groups}</tr><tr>{names}</tr></thead>"
        f'<tbody>{"".join(rows)}</tbody></table></div><p class="note">{escape(table.note)}.</p>'
    )
