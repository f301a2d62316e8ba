"""Every cell of a bench on its page: its figures, its terms, its command and its files."""

import shlex
from html import escape
from urllib.parse import quote

from evsplat.benching.cell import DONE, Cell
from evsplat.benching.figures import Record, Records
from evsplat.benching.folder import BenchFolder
from evsplat.evaluation.tables import REGION_TITLES, terms
from evsplat.pages import folded, section
from evsplat.wording import counted

_HEADS = ("", "seed", *REGION_TITLES.values(), "minutes", "files")


def cells_section(records: Records, folder: BenchFolder) -> str:
    """A folded table per capture of the cells that are over, each with links beside the page."""
    tables = "".join(
        folded(f"{name}: {counted(len(over), 'cell')}", _table(records, over, folder))
        for name in records.captures
        if (over := [cell for cell in records.plan.cells if _over(records, cell, name)])
    )
    notes = sorted(
        f"{name}: {summary}"
        for name, summary in {
            item
            for record in records.by_cell.values()
            for item in record.get("protocol_notes", {}).items()
        }
    )
    protocols = "".join(f"<li>{escape(note)}.</li>" for note in notes)
    return section(
        "Every cell",
        "PSNR in dB under protocol standard. Each command repeats its cell in a folder of its own.",
        tables + (f'<ul class="note">{protocols}</ul>' if protocols else ""),
    )


def _over(records: Records, cell: Cell, capture: str) -> bool:
    return cell.capture.name == capture and _key(cell) in records.by_cell


def _key(cell: Cell) -> tuple[str, str, int]:
    return cell.capture.name, cell.row, cell.seed


def _table(records: Records, cells: list[Cell], folder: BenchFolder) -> str:
    order = [row.name for row in records.plan.suite.rows]
    cells = sorted(cells, key=lambda cell: (order.index(cell.row), cell.seed))
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in _HEADS)
    lines = "".join(_lines(records, cell, folder) for cell in cells)
    return (
        f'<div class="scroll"><table class="cells"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>"
    )


def repeat_command(records: Records, cell: Cell, record: Record) -> str:
    """The command that runs one cell again, on as many threads, in the folder ``repeated``."""
    plan = records.plan
    capture = next(c for c in plan.suite.captures if c.name == cell.capture.name)
    words = ["evsplat", "bench", plan.named, "--out", "repeated", "--seeds", str(cell.seed)]
    if plan.draw_seed is not None:
        words += ["--seed", str(plan.draw_seed)]
    packaged = capture.path in (None, "demo")
    words += ["--captures", capture.name if packaged else str(capture.path)]
    row = next(row for row in plan.suite.rows if row.name == cell.row)
    words += ["--add", f"{row.name}={row.pictures}"] if row.added else ["--only", cell.row]
    if cell.iterations is not None:
        words += ["--iterations", str(cell.iterations)]
    if cell.max_minutes is not None:
        words += ["--max-minutes", f"{cell.max_minutes:g}"]
    if record.get("threads"):
        words += ["--cpus-per-cell", str(record["threads"])]
    return shlex.join(words)


def _lines(records: Records, cell: Cell, folder: BenchFolder) -> str:
    """Figures and files of a cell; below them its terms and its command."""
    record = records.by_cell[_key(cell)]
    title = next(row.label for row in records.plan.suite.rows if row.name == cell.row)
    run = folder.run_of(cell.id)
    files = {
        "record": folder.record_of(cell.id),
        "log": folder.log_of(cell.id),
        "settings": run / "config.yaml",
        "pictures": run / "pictures",
    }
    links = " ".join(
        f'<a href="{quote(path.relative_to(folder.path).as_posix())}">{name}</a>'
        for name, path in files.items()
        if path.exists()
    )
    if record["status"] == DONE:
        told = terms(record)
        regions = record["protocols"]["standard"]
        psnr = [regions.get(region, {}).get("psnr") for region in REGION_TITLES]
        figures = ["–" if value is None else f"{value:.2f}" for value in psnr]
        seconds = record.get("train_seconds")
        figures.append("–" if seconds is None else f"{seconds / 60:.1f}")
    else:
        told = f"failed: {record['reason']}"
        figures = ["–"] * (len(REGION_TITLES) + 1)
    values = "".join(f"<td>{figure}</td>" for figure in (cell.seed, *figures))
    command = escape(repeat_command(records, cell, record))
    return (
        f'<tr><th scope="row">{escape(title)}</th>{values}<td>{links}</td></tr>'
        f'<tr class="terms"><td colspan="{len(_HEADS)}">{escape(told)}<br>'
        f"<code>{command}</code></td></tr>"
    )
