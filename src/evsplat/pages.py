"""HTML pieces of pages that are one file each: the document, sections, embedded pictures."""

import base64
import io
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from evsplat.untrusted.pictures import read_picture
from evsplat.wording import counted

_LOSSLESS_PIXELS = 6_000_000
"""Up to this many pixels in all, pictures are embedded without loss; beyond, at quality 92."""


def document(title: str, body: str, *, style: str | None = None) -> str:
    """The whole page; ``style`` is a sheet of `evsplat.data` after that of reports."""
    data = resources.files("evsplat") / "data"
    sheets = ("report.css", *([style] if style else []))
    styles = "".join((data / name).read_text(encoding="utf-8") for name in sheets)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{styles}</style></head><body>{body}"
        "</body></html>\n"
    )


def section(title: str, intro: str, body: str) -> str:
    """A titled section; all three arguments are HTML."""
    lead = f'<p class="intro">{intro}</p>' if intro else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def folded(title: str, body: str) -> str:
    """HTML behind a line of text to click on; nothing for an empty body."""
    return f"<details><summary>{escape(title)}</summary>{body}</details>" if body else ""


def more(shown: int, rest: int, item: str) -> str:
    """Title of folded items: all of the rest, or so many of it."""
    some = "" if shown == rest else f"{shown} of "
    return some + counted(rest, f"more {item}")


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


def legend(gradient: str, low: str, high: str, title: str) -> str:
    """A colour scale with text at both ends."""
    return (
        f'<p class="scale"><span>{escape(title)}:</span><span>{escape(low)}</span>'
        f'<i style="background:{gradient}"></i><span>{escape(high)}</span></p>'
    )


@dataclass(frozen=True)
class Embedder:
    """Turns pictures into image elements."""

    lossless: bool

    @classmethod
    def for_pixels(cls, count: int) -> "Embedder":
        """Without loss where ``count`` pixels in all leave the page small enough."""
        return cls(lossless=count <= _LOSSLESS_PIXELS)

    def image(self, picture: UInt8[np.ndarray, "H W 3"], alt: str) -> str:
        """An image element with the picture inside."""
        buffer = io.BytesIO()
        # Without loss the least effort takes a third to a quarter of the time of method 2 for a
        # tenth more bytes.
        if self.lossless:
            Image.fromarray(picture).save(buffer, "WEBP", lossless=True, quality=0, method=0)
        else:
            # Method 4, Pillow's default, takes twice as long for as many bytes.
            Image.fromarray(picture).save(buffer, "WEBP", quality=92, method=2)
        height, width = picture.shape[:2]
        return (
            f'<img src="{data_uri(buffer.getvalue(), "image/webp")}" width="{width}" '
            f'height="{height}" alt="{escape(alt)}" decoding="async">'
        )


def read_rgb(path: Path, remedy: str) -> UInt8[np.ndarray, "H W 3"]:
    """A picture that was written by an evaluation; ``remedy`` says what to do without it."""
    return read_picture(
        path, lambda image: np.asarray(image.convert("RGB")), fault="not readable", remedy=remedy
    )


def data_uri(content: bytes, media_type: str) -> str:
    """``content`` as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"
