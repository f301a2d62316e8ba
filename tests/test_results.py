"""Published tables say what the records that the repository keeps say, and nothing else."""

import sys
from pathlib import Path

import pytest

from evsplat.benching.cell import DONE, read_cell_record
from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import Plan, make_plan, pending_cells
from evsplat.benching.suite import Suite, SuiteRow, read_suite

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


@pytest.mark.parametrize(
    "crop_db, length",
    [
        ([25.0], 0),
        ([25.0, 25.1, 27.0], 0),  # what comes after the knee does not count
        ([25.0, 25.3, 25.4], 1),
        ([25.0, 25.3, 25.6], 2),
        ([25.0, None, 25.6], 2),  # a length that did not run says nothing
        ([], 0),
    ],
)
def test_a_row_stands_at_the_first_length_whose_doubling_brings_too_little(crop_db, length):
    rows = tuple(SuiteRow(name, "paper") for name in ("ours", "ours", "ours_16000"))
    tables = [
        Records(
            Plan(Suite("s", rows[at : at + 1]), {}, {}, ()),
            {
                ("c", rows[at].name, seed): {
                    "status": DONE,
                    "cell": {"seed": seed},
                    "protocols": {"standard": {"person_crop": {"psnr": value + seed - 0.5}}},
                }
                for seed in range(2)
            },
        )
        for at, value in enumerate(crop_db)
        if value is not None
    ]
    records = tables[0] if crop_db else Records(Plan(Suite("s", rows[:1]), {}, {}, ()), {})
    longer = Records(
        Plan(Suite("longer", (*rows[1:], SuiteRow("other_32000", "paper"))), {}, {}, ()),
        {key: record for table in tables[1:] for key, record in table.by_cell.items()},
    )
    of, row = results._knee_of(records, longer, "ours", "c")
    assert (of is longer, row) == (length > 0, rows[length].name)
