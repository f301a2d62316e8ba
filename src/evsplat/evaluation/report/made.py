"""Films and pages that were made of the run: shown and linked at the end of its report."""

import os
from html import escape
from pathlib import Path
from urllib.parse import quote

from evsplat.evaluation.report.source import Source
from evsplat.pages import data_uri, section
from evsplat.untrusted.faults import open_bytes

_MEDIA = {".mp4": "video/mp4", ".webp": "image/webp"}
_MOST_BYTES = 16_000_000
"""Of the films on a page, all together; those that do not fit are linked."""


def films_and_pages(source: Source) -> str:
    """What lies in ``renders`` and ``exports`` of the run folder, in the order of its names."""
    left, shown, links = _MOST_BYTES, [], []
    for path in _files(source.folder / "renders", tuple(_MEDIA)):
        size = path.stat().st_size
        if size > left:
            links.append(_link(source.folder, path))
            continue
        left -= size
        with open_bytes(path) as file:
            uri = data_uri(file.read(), _MEDIA[path.suffix])
        name = escape(path.stem)
        picture = (
            f'<video autoplay loop muted playsinline controls aria-label="{name}" src="{uri}">'
            "</video>"
            if path.suffix == ".mp4"
            else f'<img src="{uri}" alt="{name}">'
        )
        shown.append(f"<figure>{picture}<figcaption>{name}</figcaption></figure>")
    links += [
        _link(source.folder, path)
        for pattern in ("*.html", "*/index.html")
        for path in _files(source.folder / "exports", (".html",), pattern)
    ]
    if not shown and not links:
        return ""
    films = f'<div class="films">{"".join(shown)}</div>' if shown else ""
    pages = f"<ul>{''.join(links)}</ul>" if links else ""
    return section("Films and pages", "", films + pages)


def _files(folder: Path, suffixes: tuple[str, ...], pattern: str = "*") -> list[Path]:
    """Ordinary files; pipes and links out of the folder are passed over."""
    found = sorted(folder.glob(pattern)) if folder.is_dir() else []
    return [p for p in found if p.suffix in suffixes and p.is_file() and not p.is_symlink()]


def _link(folder: Path, path: Path) -> str:
    place = path.relative_to(folder).as_posix()
    return f'<li><a href="{quote(os.fsencode(place))}">{escape(place)}</a></li>'
