"""Published tables say what the records that the repository keeps say, and nothing else."""

import sys
from pathlib import Path

import pytest

from evsplat.benching.cell import DONE, read_cell_record
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import make_plan, pending_cells
from evsplat.benching.suite import read_suite

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import results  # noqa: E402


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return results.texts()


@pytest.mark.parametrize("page", results.PAGES)
def test_every_table_is_the_one_that_its_records_make(made, page):
    text = (ROOT / page).read_text("utf-8")
    assert results.filled(text, made) == text, "python tools/results.py writes it anew"


def test_every_kept_record_is_small_and_says_where_it_is_from():
    paths = list(results.KEPT.glob("*/*/*/seed*.json"))
    assert len(paths) > 100
    for path in paths:
        record = read_cell_record(path)
        assert path.stat().st_size < 12_000, path
        assert record["status"] == DONE and record["machine"], path
        assert not record["code"]["commit"].endswith("+"), path


def test_the_kept_records_of_the_grid_are_of_the_captures_that_it_draws(tmp_path):
    """`evsplat bench grid --records docs/results/grid` has nothing left to run."""
    folder = BenchFolder(tmp_path, results.KEPT / "grid")
    assert pending_cells(make_plan(read_suite("grid"), folder), folder, retry=False) == []


def test_a_page_keeps_what_stands_between_its_tables(made):
    page = "a\n<!-- results: grid-summary -->\nold\n<!-- end of results -->\nb\n"
    filled = results.filled(page, made)
    assert filled.startswith("a\n") and filled.endswith("\nb\n")
    assert made["grid-summary"] in filled and "old" not in filled
