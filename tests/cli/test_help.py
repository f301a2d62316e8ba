"""The pages of ``--help``, each read as a terminal of 80 and of 100 columns shows it."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from evsplat.cli import main
from evsplat.cli.main import _VERBS
from evsplat.importers import KINDS

PAGES = [[], *([verb] for verb in _VERBS), *(["import", kind] for kind in [*KINDS, "poses"])]


@dataclass
class Entry:
    """An argument of a page: its names and placeholders, and its explanation line by line."""

    box: str
    name: str
    lines: list[str]
    room: int
    """Columns of a line."""


_PAGES: dict[tuple[str, int], str] = {}
"""What was shown, by words and columns: several tests read one page."""


def page_of(capsys, monkeypatch, words: list[str], columns: int) -> str:
    shown = " ".join(words), columns
    if shown not in _PAGES:
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit) as stop:
            main([*words, "--help"])
        assert stop.value.code == 0
        _PAGES[shown] = capsys.readouterr().out
    return _PAGES[shown]


def entries(page: str) -> Iterator[Entry]:
    """The arguments of a page's boxes."""
    boxes = re.split(r"(?m)^ (positional arguments|options|subcommands) +\n -+ \n", page)[1:]
    for title, box in zip(boxes[::2], boxes[1::2], strict=True):
        if title != "subcommands":
            rows = [row[2:] for row in box.splitlines()][:-1]  # ends with an empty one
            yield from _of_box(title, rows, len(re.search("(?m)^  (-h.*?)show", page)[1]))


def _of_box(title: str, rows: list[str], column: int) -> list[Entry]:
    """Names stand at the left; the explanation beside them, or below where they are long."""
    found: list[Entry] = []
    for row in rows:
        is_name = not row.startswith(" ")
        is_long = is_name and not row[:column].endswith("  ")
        if is_name:
            name = row if is_long else row[:column]
            found.append(Entry(title, name.strip(), [], len(row) - column))
        if not is_long:
            found[-1].lines.append(row[column:].rstrip())
    return found


@pytest.mark.parametrize("columns", [80, 100])
@pytest.mark.parametrize("words", PAGES, ids=" ".join)
def test_every_argument_reads_as_one_text(capsys, monkeypatch, words, columns):
    found = list(entries(page_of(capsys, monkeypatch, words, columns)))
    assert found
    for entry in found:
        text = " ".join(entry.lines)
        assert len(text) > 10 and all(entry.lines), entry
        assert not re.search(r"\(default: (True|False|None)?\)", text), entry
        assert not re.search(r"\b(INT|STR|FLOAT|BOOL)\b", entry.name), entry
        for line, below in zip(entry.lines, entry.lines[1:], strict=False):
            assert len(line) + 1 + len(below.split()[0]) > entry.room, f"broken early: {entry}"


@pytest.mark.parametrize("words", PAGES, ids=" ".join)
def test_what_may_be_left_out_stands_in_brackets(capsys, monkeypatch, words):
    page = page_of(capsys, monkeypatch, words, 100)
    for entry in entries(page):
        if entry.box == "positional":
            is_required = "(required)" in " ".join(entry.lines)
            assert entry.name.startswith("[") is not is_required, entry


@pytest.mark.parametrize(
    ("words", "order"),
    [
        (["train"], "--out --max-minutes --set --no-evaluate --port"),
        (["render"], "--out --what --motion --events --threads"),
        (["import", "video"], "--out --events --exposure-us --find-poses --body --keypoints"),
    ],
)
def test_options_stand_as_declared(capsys, monkeypatch, words, order):
    names = [entry.name.split()[0] for entry in entries(page_of(capsys, monkeypatch, words, 80))]
    assert [name for name in names if name in order.split()] == order.split()


def test_your_own_recording_is_the_first_kind(capsys, monkeypatch):
    page = page_of(capsys, monkeypatch, ["import"], 80)
    kinds = re.findall(r"• (\S+)", page)
    assert kinds[:3] == ["folder", "video", "davis"] and {*KINDS} < {*kinds}
