"""Small pieces that the sections of the report share."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import TypeVar

from evsplat.evaluation.tables import REGION_TITLES

Item = TypeVar("Item")


def section(title: str, intro: str, body: str) -> str:
    """A titled section; all three arguments are HTML."""
    lead = f'<p class="intro">{intro}</p>' if intro else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def folded(title: str, body: str) -> str:
    """HTML behind a line of text to click on; nothing for an empty body."""
    return f"<details><summary>{escape(title)}</summary>{body}</details>" if body else ""


def more(shown: int, there: int, what: str) -> str:
    """What is behind a click: all of the rest, or so many of it."""
    return f"{shown} more {what}" if shown == there else f"{shown} of {there} more {what}"


def compare(left: str, right: str, caption: str) -> str:
    """Two image elements of one size behind a slider; side by side in print."""
    return (
        f'<figure class="both"><div class="compare">{left}<div class="over">{right}</div>'
        '<input type="range" min="0" max="100" value="50" step="any" '
        f'aria-label="{escape(caption)}" '
        "oninput=\"this.parentNode.style.setProperty('--x',this.value+'%')\"></div>"
        f'<figcaption><span class="screen">drag: </span>{escape(caption)}</figcaption></figure>'
    )


def figure(image: str, caption: str = "") -> str:
    """An image element with a line of text below."""
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{image}{text}</figure>"


def legend(gradient: str, low: str, high: str, what: str) -> str:
    """A colour scale with text at both ends."""
    return (
        f'<p class="scale"><span>{escape(what)}:</span><span>{escape(low)}</span>'
        f'<i style="background:{gradient}"></i><span>{escape(high)}</span></p>'
    )


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` items, evenly spread, the first and the last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def frame_figures(figures: Mapping[str, Mapping[str, float | None]]) -> str:
    """PSNR per region as text that continues a line; empty where nothing is known."""
    parts = [
        f"{title} {value:.2f} dB"
        for region, title in REGION_TITLES.items()
        if region in figures and (value := figures[region]["psnr"]) is not None
    ]
    return " · " + " · ".join(parts) if parts else ""
