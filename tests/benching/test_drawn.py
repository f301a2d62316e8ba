"""Captures drawn by a seed: the same for everybody, and others for another seed."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from evsplat.benching.cell import CaptureSource, Cell
from evsplat.benching.drawn import Draw, drawn_settings
from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import Plan, make_plan
from evsplat.benching.suite import Suite, SuiteRow, read_suite
from evsplat.benching.tables import make_tables
from evsplat.errors import ConfigError


def test_a_draw_is_decided_by_its_seed_and_a_longer_one_begins_with_a_shorter():
    short, long = (drawn_settings(Draw(5, count)) for count in (3, 9))
    assert list(long.items())[:3] == list(short.items())
    other = drawn_settings(Draw(6, 9))
    assert not set(other) & set(long)
    assert list(other.values()) != list(long.values())


def test_what_is_drawn_varies_in_everything_and_stays_within_what_is_said():
    found = list(drawn_settings(Draw(1, 60, frames=20)).values())
    for name in ("character", "motion", "fps", "events", "pose_noise"):
        assert len({asdict(settings)[name] for settings in found}) >= 3, name
    for settings in found:
        assert settings.frames <= 20
        assert 0.3 <= settings.exposure_ms * settings.fps / 1000 <= 0.9 or (
            settings.exposure_ms <= 80
        )


def test_the_grid_is_drawn_anew_by_its_seed_and_can_be_run_in_part(tmp_path):
    suite, folder = read_suite("grid"), BenchFolder(tmp_path)
    plan = make_plan(suite, folder)
    assert len(plan.sources) == 24 and plan.draw_seed == 0
    other = make_plan(suite, folder, draw_seed=7)
    assert other.draw_seed == 7 and not set(other.sources) & set(plan.sources)
    name = list(plan.sources)[4]
    part = make_plan(suite, folder, captures=[Path(name)], only=["paper"])
    assert [cell.id for cell in part.cells] == [f"{name}/paper/seed0"]
    assert part.sources[name] == plan.sources[name]


def test_a_seed_of_the_draw_needs_a_suite_that_draws(tmp_path):
    with pytest.raises(ConfigError, match="--seeds"):
        make_plan(read_suite("stage"), BenchFolder(tmp_path), draw_seed=1)
    both = tmp_path / "both.yaml"
    both.write_text(
        "name: s\ncaptures: [{name: c, path: demo}]\ndraw: {seed: 1}\n"
        "rows: [{name: a, method: paper}]\n"
    )
    with pytest.raises(ConfigError, match="keep one of them"):
        read_suite(both)


def test_many_captures_are_compared_line_by_line():
    """Mean, worst and wins of two rows on eight captures, of which one lacks the second row.

    The camera's own picture, which no method sees, is nowhere the best.
    """
    methods = {"a": "paper", "b": "paper", "own": "own_picture"}
    rows = tuple(SuiteRow(name, method) for name, method in methods.items())
    sources = {f"c{n}": CaptureSource(f"c{n}", Path("c"), "x") for n in range(8)}
    cells = tuple(
        Cell(source, row.name, 0, row.method, None, (), 10, None)
        for source in sources.values()
        for row in rows
    )
    plan = Plan(Suite("s", rows), sources, {}, cells)
    psnr = {"a": [20.0 + n for n in range(8)], "b": [23.0] * 8, "own": [40.0] * 8}
    none = {"psnr": None, "ssim": None, "lpips_vgg": None, "lpips_alex": None, "st_lpips": None}

    def record(value):
        measured = {"full": none, "person_crop": none, "person_mask": {**none, "psnr": value}}
        return {
            "status": "done",
            "cell": {"seed": 0},
            "protocols": {"standard": measured, "avatar-compat": measured},
            "iteration": 10,
            "train_seconds": 1.0,
            "gaussians": {"human": 1},
            "frames": {"test": 2},
        }

    found = {
        (capture, row.name, 0): record(psnr[row.name][n])
        for n, capture in enumerate(sources)
        for row in rows
        if (capture, row.name) != ("c0", "b")
    }
    tables = make_tables(Records(plan, found))
    table = next(table for table in tables if table.by_row)
    assert [row.title for row in table.rows] == list(sources)
    # b wins where it has 23 dB against less; at c3 both share the first place.
    assert table.footnotes[0] == "a: mean 23.50, worst 20.00 (c0), best on 5 of 8 captures."
    assert table.footnotes[1] == "b: mean 23.00, worst 23.00 (c1), best on 3 of 7 captures."
    assert table.footnotes[2] == "own: mean 40.00, worst 40.00 (c0)."
    assert replace(table, by_row=False).rank(table.rows[1], 0) == 0
