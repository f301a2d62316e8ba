"""One page with the tables and all methods side by side for every test frame; no other file."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from evsplat.benching.cells_page import cells_section
from evsplat.benching.figures import Record, Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.tables import SPREAD
from evsplat.capture import Capture, Frame, load_capture
from evsplat.evaluation.regions import HumanRegions
from evsplat.evaluation.tables import LEGEND, Table, html
from evsplat.pages import Embedder, document, folded, read_rgb, section
from evsplat.pictures import to_bytes
from evsplat.pictures.box import Box
from evsplat.spread import evenly_spread
from evsplat.wording import counted

_PIXELS = 60_000_000
"""Pixels of all pictures of the page; beyond, captures show fewer frames, evenly spread."""
_OPEN = 3
"""Frames of a capture that show at once; the others are folded."""


@dataclass(frozen=True)
class _Row:
    """A line of the table as it shows in pictures: of its first seed."""

    title: str
    record: Record | None
    run: str
    reason: str
    """The reason for no result."""


def page(records: Records, tables: Sequence[Table], folder: BenchFolder) -> str:
    """The page as HTML; all that comes from the user's files is escaped."""
    suite = records.plan.suite
    title = suite.title or suite.name
    figures = "".join(
        section(escape(table.title), escape(table.note), html(table)) for table in tables
    )
    captures = {
        name: load_capture(source.path)
        for name, source in records.plan.sources.items()
        if any(records.drawn(name, row.name) for row in suite.rows)
    }
    budget = _PIXELS // max(len(captures), 1)
    pictures = "".join(
        _capture(records, name, capture, folder, budget) for name, capture in captures.items()
    )
    done = sum(record["status"] == "done" for record in records.by_cell.values())
    body = (
        '<input type="checkbox" id="person" checked aria-label="person only">'
        f'<header><p class="kicker">evsplat · bench · {escape(suite.name)}</p>'
        f'<h1>{escape(title)}</h1><p class="lead">{done} of {len(records.plan.cells)} cells. '
        f"{LEGEND.format(second='underlined')} {SPREAD}</p></header>"
        f"<main>{figures}{pictures}{cells_section(records, folder)}</main>"
    )
    return document(title, body, style="bench.css")


def _capture(
    records: Records, name: str, capture: Capture, folder: BenchFolder, budget: int
) -> str:
    """All test frames of a capture, each with every row."""
    rows = []
    for row in records.plan.suite.rows:
        found = records.drawn(name, row.name)
        record = found[0] if found else None
        run = "" if record is None else f"{name}/{row.name}/seed{record['cell']['seed']}"
        rows.append(_Row(row.label, record, run, records.reason_for_gap(name, row.name)))
    camera = next(iter(capture.cameras.values()))
    of_frame = camera.width * camera.height * (len(rows) + 2)
    frames = evenly_spread(capture.test_frames, max(2, budget // of_frame))
    shown = evenly_spread(frames, _OPEN)
    human_regions = HumanRegions(capture)
    # Pictures of many methods: light compression is seen by nobody at this size.
    embed = Embedder(lossless=False)
    draw = {
        frame.name: _frame(capture, human_regions, frame, rows, folder, embed) for frame in frames
    }
    others = "".join(draw[frame.name] for frame in frames if frame not in shown)
    left = len(capture.test_frames) - len(frames)
    intro = f"Measured but not shown: {counted(left, 'more test frame')}. " if left else ""
    return section(
        escape(name),
        intro + "PSNR of the person crop, protocol standard.",
        '<div class="switch"><label for="person"><span class="near">show whole pictures</span>'
        '<span class="whole">show the person only</span></label></div>'
        + "".join(draw[frame.name] for frame in shown)
        + folded(counted(len(frames) - len(shown), "more test frame"), others),
    )


def _frame(
    capture: Capture,
    human_regions: HumanRegions,
    frame: Frame,
    rows: Sequence[_Row],
    folder: BenchFolder,
    embed: Embedder,
) -> str:
    box, camera = human_regions.crop(frame), capture.camera(frame)
    style = "" if box is None else _window(box, camera.width)
    blurry = to_bytes(capture.shown(capture.image(frame)))
    tiles = [_tile(embed.image(blurry, "blurry input"), style, "recorded")]
    if frame.sharp is not None:
        truth = embed.image(to_bytes(capture.shown(capture.sharp(frame))), "sharp truth")
        tiles.append(_tile(truth, style, "truth"))
    for row in rows:
        entry = None if row.record is None else _entry(row.record, frame.name)
        if entry is None:
            tiles.append(
                f'<figure><div class="tile gap">{escape(row.reason)}</div>'
                f"<figcaption><b>{escape(row.title)}</b></figcaption></figure>"
            )
            continue
        file = folder.run_of(row.run) / entry["pictures"]["render"]
        remedy = f"remove {folder.record_of(row.run)} to measure it again"
        picture = read_rgb(file, remedy)
        tiles.append(_tile(embed.image(picture, row.title), style, row.title, _reached(entry)))
    return (
        f'<article class="frame"><h3>Frame {escape(frame.name)}</h3>'
        f'<div class="tiles">{"".join(tiles)}</div></article>'
    )


def _reached(entry: Record) -> str:
    """A frame's PSNR on the person crop; that of the full frame, where nobody is in it, says so."""
    figures = entry["protocols"]["standard"]
    for region, where in (("person_crop", ""), ("full", ", full frame")):
        if (psnr := figures[region]["psnr"]) is not None:
            return f"{psnr:.2f}\u00a0dB{where}"
    return ""


def _tile(image: str, style: str, title: str, note: str = "") -> str:
    return (
        f'<figure><div class="tile"{style}>{image}</div>'
        f"<figcaption><b>{escape(title)}</b> {escape(note)}</figcaption></figure>"
    )


def _window(box: Box, width: int) -> str:
    """The part of the picture that shows, in shares of the tile's own width and height."""
    wide, high = box.right - box.left, box.bottom - box.top
    return (
        f' style="--a:{wide}/{high};--w:{100 * width / wide:.2f}%;'
        f'--x:{-100 * box.left / wide:.2f}%;--y:{-100 * box.top / high:.2f}%"'
    )


def _entry(record: Record, frame: str) -> Record | None:
    return next((entry for entry in record["per_frame"] if entry["frame"] == frame), None)
