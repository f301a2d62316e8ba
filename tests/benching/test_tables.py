"""Tables of made-up records, against figures computed by hand."""

import re
from dataclasses import asdict, replace
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import pytest

from evsplat.benching.cell import CaptureSource, Cell
from evsplat.benching.figures import Records, metric
from evsplat.benching.plan import Plan
from evsplat.benching.suite import Published, PublishedTable, Suite, SuiteRow
from evsplat.benching.tables import make_tables
from evsplat.capture import Policy
from evsplat.evaluation.protocols import METRICS, PROTOCOLS, REGIONS
from evsplat.evaluation.tables import html, latex, markdown

PSNR = {
    ("one", "good"): {0: 30.0, 1: 32.0},
    ("two", "good"): {0: 20.0, 1: 24.0},
    ("one", "poor"): {0: 28.0, 1: 28.0},
    ("two", "poor"): {0: 21.0, 1: 21.0},
    ("one", "half"): {0: 99.0, 1: 99.0},
}


def record(psnr: float, seed: int) -> dict:
    values = dict.fromkeys(METRICS, None) | {"psnr": psnr, "ssim": psnr / 100}
    return {
        "status": "done",
        "cell": {"seed": seed},
        "protocols": {p.name: {region: dict(values) for region in REGIONS} for p in PROTOCOLS},
        "weights": {"lpips_vgg": {"sha256": None, "reason": "fetch <it> & put_it there"}},
        "iteration": 100,
        "train_seconds": 60.0,
        "gaussians": {"human": 3, "scene": 4},
        "frames": {"train": 7, "test": 3},
        "policy": asdict(Policy()),
    }


@pytest.fixture
def records() -> Records:
    rows = tuple(
        SuiteRow(name, "paper", title, published=published)
        for name, title, published in (
            ("good", "Good*", Published(31.91, 0.9736, 0.0726)),
            ("poor", "Poor & Sons†", None),
            ("half", "half", None),
            ("none", "none", Published(26.7, 0.9366, 0.1075)),
        )
    )
    suite = Suite("s", rows, seeds=(0, 1), published=PublishedTable("Table 1", ("one", "other")))
    sources = {name: CaptureSource(name, Path(name), "x") for name in ("one", "two")}
    cells = tuple(
        Cell(sources[capture], row.name, seed, "paper", None, (), 100, None)
        for seed in (0, 1)
        for capture in sources
        for row in rows
    )
    found = {
        (*place, seed): record(psnr, seed)
        for place, values in PSNR.items()
        for seed, psnr in values.items()
    }
    failure = {"status": "failed", "reason": "it_broke"}
    for seed in (0, 1):
        found["two", "half", seed] = failure
        found["one", "none", seed] = failure
    return Records(Plan(suite, sources, {"third": "third: not found."}, cells), found)


def test_mean_is_over_captures_and_spread_over_seeds(records):
    figure = records.figure("good", metric("standard", "full", "psnr"), ["one", "two"])
    # Seed 0 has the mean 25, seed 1 the mean 28: their standard deviation is 3 / sqrt(2).
    assert figure.mean == pytest.approx(26.5)
    assert figure.spread == pytest.approx(3 / 2**0.5)


def test_best_and_second_are_of_rows_that_have_every_capture(records):
    table = next(t for t in make_tables(records) if t.title.endswith("protocol standard"))
    shown = {row.title: table.cells(row, ("{}", "1: {}", "2: {}"))[0] for row in table.rows}
    assert shown["Good*"] == "1: 26.50 ± 2.12"
    assert shown["Poor & Sons†"].startswith("2: ")
    assert shown["half (1 of 2 captures)"].startswith("99.00")
    assert shown["none (failed)"] == "–"


def test_on_each_capture_the_rows_that_have_it_compete(records):
    """A row without the first capture is the best on the second, and says what it lacks."""
    for seed in (0, 1):
        records.by_cell["two", "none", seed] = record(50.0, seed)
    table = next(t for t in make_tables(records) if t.title.startswith("PSNR of every capture"))
    shown = {row.title: table.cells(row, ("{}", "1: {}", "2: {}")) for row in table.rows}
    of_two = len(REGIONS)
    assert shown["half (1 of 2 captures)"][0].startswith("1: 99.00")
    assert shown["none (1 of 2 captures)"][of_two].startswith("1: 50.00")
    assert shown["Good*"][of_two].startswith("2: ")
    assert "Test frames: 3 + 3." in table.note


def test_published_figures_stand_beside_ours_of_the_same_captures(records):
    table = make_tables(records)[0]
    assert table.groups[0] == ("published", 3)
    rows = {row.title: table.cells(row, ("{}", "{}", "{}")) for row in table.rows}
    assert rows["Good*"][:4] == ["31.91", "0.9736", "0.0726", "31.00 ± 1.41"]
    assert rows["Poor & Sons†"][:3] == ["–", "–", "–"]
    assert any("1 of the 2 published captures; missing: other" in note for note in table.footnotes)
    without = replace(records.plan.suite, published=PublishedTable("Table 1", ("other",)))
    plan = replace(records.plan, suite=without)
    assert (
        make_tables(replace(records, plan=plan))[0].title
        == "Mean over 2 captures, protocol standard"
    )


def test_every_gap_has_its_reason(records):
    notes = make_tables(records)[0].footnotes
    assert "half failed on two seed 0, two seed 1: it_broke" in notes
    assert "third: not found." in notes
    assert "fetch <it> & put_it there" in notes
    assert "4 of 16 cells have not been run yet." not in notes
    assert "2 of 16 cells have not been run yet." in notes


def test_every_form_of_a_table_says_below_what_a_baseline_differs_in(records):
    """Once for all rows of it, whatever marks their titles have."""
    methods = {"good": "hugs", "poor": "hugs", "half": "avatar3dgs_semantic"}
    rows = tuple(
        replace(row, method=methods.get(row.name, row.method)) for row in records.plan.suite.rows
    )
    suite = replace(records.plan.suite, rows=rows)
    tables = make_tables(replace(records, plan=replace(records.plan, suite=suite)))
    note = "Good*; Poor & Sons†: HUGS with slips of its released code repaired (docs/baselines.md)."
    of_avatar = next(note for note in tables[0].footnotes if note.startswith("half: 3DGS-Avatar"))
    for note_there in (note, of_avatar):
        assert tables[0].footnotes.count(note_there) == 1
        assert f"% {note_there}" in latex(tables)
        assert f"<li>{escape(note_there)}</li>" in html(tables[0])
        assert note_there.replace("*", "\\*") in markdown("", "", tables)
    assert not any("baselines.md" in note for note in make_tables(records)[0].footnotes)


def test_latex_rows_have_as_many_cells_as_columns_and_nothing_unescaped(records):
    text = latex(make_tables(records))
    for body in re.findall(r"\\begin\{tabular\}\{(l r*|lr*)\}(.*?)\\end", text, re.DOTALL):
        lines = [line for line in body[1].splitlines() if line.endswith(r"\\")]
        for line in lines[1:]:
            assert len(re.findall(r"(?<!\\)&", line)) == len(body[0]) - 1
    assert r"Poor \& Sons$^\dagger$" in text
    assert r"\textbf{26.50 $\pm$ 2.12}" in text
    assert r"\underline{24.50" in text


def test_markdown_and_html_escape_what_users_write(records):
    text = markdown("T", "", make_tables(records))
    assert "it\\_broke" in text and "Good\\*" in text
    width = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert min(width) > 4
    page = "".join(html(table) for table in make_tables(records))
    assert "fetch &lt;it&gt; &amp; put_it" in page
    open_tags: list[str] = []

    class Balance(HTMLParser):
        def handle_starttag(self, tag, attrs):
            open_tags.append(tag)

        def handle_endtag(self, tag):
            assert open_tags.pop() == tag

    Balance().feed(page)
    assert open_tags == []


def test_the_caption_says_the_terms_and_a_row_where_it_departs_from_them(records):
    table = make_tables(records)[1]
    assert "saw no picture, mask or event of a held-out interval" in table.note
    assert "100 training steps, of schedules made for 15,000. Test frames: 3 + 3." in table.note
    departing = asdict(Policy(held_out_events=True, masks="given"))
    for key, record in records.by_cell.items():
        if key[1] == "poor":
            record["policy"] = departing
    titles = [row.title for row in make_tables(records)[1].rows]
    assert titles[0] == "Good*"
    assert titles[1] == "Poor & Sons†; events of held-out intervals seen; masks given"


def test_a_capture_on_which_a_row_has_no_figure_is_named_with_the_reason(records):
    for seed in (0, 1):
        found = records.by_cell["two", "poor", seed]
        for region in found["protocols"]["standard"].values():
            region.update(dict.fromkeys(region))
        found["reasons"] = {"protocols.standard.full.psnr": "no frame has a sharp picture"}
    notes = make_tables(records)[0].footnotes
    assert "Poor & Sons† has no figure on two: no frame has a sharp picture." in notes
    assert not any(note.startswith("Good*") for note in notes)
