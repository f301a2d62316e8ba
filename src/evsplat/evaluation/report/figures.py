"""The figures: large cards, one table per protocol, and what could not be measured."""

from collections.abc import Mapping
from html import escape
from typing import Any

from evsplat.capture.policy import terms_of
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.splits import counted_frames, split_of
from evsplat.evaluation.tables import (
    REGION_TITLES,
    Table,
    html,
    input_is_truth,
    missing_networks,
    tables_of,
    terms,
    without_truth,
)
from evsplat.pages import folded, section
from evsplat.wording import begun

_REFERENCES = {"trivial": "the best trivial row", "camera": "the camera’s own blurry picture"}


def figures(source: Source) -> str:
    """The section with all means."""
    metrics = source.metrics
    why = no_test_figures(metrics)
    if why is not None:
        return section("Figures", begun(why), "")
    first, *others = tables_of(metrics)
    compat = "".join(folded(table.title, _with_note(table)) for table in others)
    remarks = [*metrics.get("remarks", ()), *missing_networks(metrics)]
    missing = "".join(f"<li>{escape(remark)}</li>" for remark in remarks)
    against = metrics.get("blurry_ground_truth", {}).get("full", {}).get("psnr")
    blurry = (
        f"<li>Against the blurry pictures instead of the sharp truth (no measure of deblurring): "
        f"{against:.2f} dB full frame.</li>"
        if against is not None and not input_is_truth(metrics)
        else ""
    )
    measured = without_truth(metrics) or (
        f"Means over {counted_frames(metrics)} against the sharp picture at mid-exposure."
    )
    return section(
        "Figures",
        f"{measured} <b>{escape(terms(metrics))}</b>",
        f'{_cards(metrics)}{_with_note(first)}{compat}<ul class="note">{blurry}{missing}</ul>',
    )


def no_test_figures(metrics: dict[str, Any]) -> str | None:
    """The reason for no test figures, as HTML that continues a sentence; None where there are."""
    if split_of(metrics) == "train":
        return None
    known = terms_of(metrics)
    if known is not None and known.use == "everything":
        events = " and every event" if known.sees_events else ""
        return (
            f"trained on every frame{events} (<code>--use everything</code>): nothing was held "
            "out, so there are no test figures."
        )
    if not metrics["per_frame"]:
        return "no frame has split “test”, so there are no test figures."
    return None


def references(metrics: dict[str, Any], region: str) -> dict[str, float]:
    """PSNR in one region of what a method is held against, as far as it is known.

    ``trivial``: the best of the rows that need no method; ``camera``: the camera's own blurry
    picture, which no method sees.
    """
    rows = metrics.get("trivial", {}).values()
    trivial = [value for row in rows if (value := row[region]["psnr"]) is not None]
    camera = metrics.get("blurry_input", {}).get(region, {}).get("psnr")
    known = {"trivial": max(trivial, default=None), "camera": camera}
    return {name: value for name, value in known.items() if value is not None}


def distance(ours: float, theirs: float, decimals: int) -> str:
    """The difference of two PSNRs, in words that a name of the second one follows."""
    apart = f"{abs(ours - theirs):.{decimals}f}"
    if float(apart) == 0:
        return "level with"
    return f"{apart} dB {'above' if ours > theirs else 'below'}"


def _cards(metrics: dict[str, Any]) -> str:
    """Large PSNR figures, each with the distance to what needs no method in the same region."""
    cards = []
    for region, title in REGION_TITLES.items():
        value = metrics["protocols"]["standard"][region]["psnr"]
        if value is None:
            continue
        lines = ""
        for name, theirs in references(metrics, region).items():
            apart = distance(value, theirs, 2)
            kind = "down" if apart.endswith("below") else "up"
            lines += f'<p class="{kind}">{apart} {_REFERENCES[name]}</p>'
        cards.append(
            f'<div class="card"><p>PSNR, {title}</p>'
            f'<p class="big">{value:.2f}<small> dB</small></p>{lines}</div>'
        )
    return f'<div class="cards">{"".join(cards)}</div>' if cards else ""


def _with_note(table: Table) -> str:
    if not table.headings:
        return ""
    corner = table.title[0].lower() + table.title[1:]
    return f'{html(table, corner)}<p class="note">{escape(table.note)}</p>'


def frame_figures(figures: Mapping[str, Mapping[str, float | None]]) -> str:
    """PSNR per region as text that continues a line; empty where nothing is known."""
    parts = [
        f"{title} {value:.2f} dB"
        for region, title in REGION_TITLES.items()
        if region in figures and (value := figures[region]["psnr"]) is not None
    ]
    return " · " + " · ".join(parts) if parts else ""
