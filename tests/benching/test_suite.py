"""Suites are read with errors that help, and those that ship say what the paper says."""

from dataclasses import dataclass, replace

import pytest

import evsplat as ev
from evsplat.benching import plan as planning
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import make_plan
from evsplat.benching.suite import SuiteCapture, read_suite, shipped_suites
from evsplat.errors import ConfigError
from evsplat.options import StageSettings

ROW = "rows: [{name: a, method: paper}]\n"


def write(tmp_path, text):
    path = tmp_path / "suite.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text, expected",
    [
        ("name: s\nrows: [{name: a, metod: paper}]", "rows.metod. Did you mean rows.method?"),
        ("name: s\nrows: [{name: a}]", "method is missing"),
        ("name: s\nrows: []", "rows is empty"),
        ("name: s\nrows: [{name: ../a, method: paper}]", "'../a'"),
        (f"name: s\nrows: [{{name: {'a' * 300}, method: paper}}]", "up to 100 letters"),
        ("name: s\nrows: [{name: a, method: m}, {name: a, method: n}]", "two rows are named a"),
        (f"name: s\ncaptures: [{{name: c}}]\n{ROW}", "either path or stage"),
        (f"name: s\nseeds: one\n{ROW}", "seeds"),
        (f"name: ../../s\n{ROW}", "suite '../../s'"),
        (
            "name: s\nrows: [{name: a, method: nearest_frame, settings: [width=3]}]",
            "row a: settings are those of a method that is trained",
        ),
        (
            "name: s\nrows: [{name: a, method: paper, settings: [iterations=3]}]",
            "row a: iterations is no setting here",
        ),
        ("name: s\nrows: [{name: a, method: pictures, pictures: ''}]", "belong together"),
        (f"name: s\ncaptures: [{{name: c, stage: {{fps: 0}}}}]\n{ROW}", "fps is 0"),
    ],
)
def test_a_wrong_suite_is_refused_with_the_place_that_is_wrong(tmp_path, text, expected):
    with pytest.raises(ConfigError) as refusal:
        read_suite(write(tmp_path, text))
    assert expected in str(refusal.value)


def test_no_suite_of_that_name_lists_those_that_ship():
    with pytest.raises(ConfigError, match="ablation, grid, mmhpsd-blur, stage, zju-mocap-blur"):
        read_suite("stages")


@pytest.mark.parametrize("name", shipped_suites())
def test_shipped_suites_name_captures_published_figures_are_of(name):
    suite = read_suite(name)
    assert suite.name == name
    published = suite.published.captures if suite.published else ()
    assert set(published) <= {capture.name for capture in suite.captures}


def test_shipped_suites_carry_the_papers_figures():
    """Relative gains over HUGS that the paper states follow from the figures in the suite."""
    figures = {row.name: row.published for row in read_suite("zju-mocap-blur").rows}
    ours, hugs = figures["paper"], figures["hugs"]
    assert round(100 * (ours.psnr / hugs.psnr - 1), 1) == 19.5
    assert round(100 * (ours.ssim / hugs.ssim - 1), 2) == 3.95
    assert round(100 * (ours.lpips / hugs.lpips - 1), 1) == -32.5


def test_missing_captures_are_told_with_the_command_that_makes_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refusal:
        ev.bench("zju-mocap-blur")
    lines = str(refusal.value).splitlines()
    assert len(lines) == 6
    assert "evsplat import zju-mocap CoreView_377 --out captures/zju_377 --blur" in lines[0]
    assert not list(tmp_path.iterdir())


def test_untrained_rows_come_first_and_only_once(tmp_path, tiny_capture):
    suite = read_suite(
        write(
            tmp_path,
            "name: s\nseeds: [0, 1]\nrows: [{name: a, method: paper}, "
            "{name: m, method: median_background}]",
        )
    )
    captures = [tiny_capture("one"), tiny_capture("two")]
    plan = make_plan(suite, BenchFolder(tmp_path), captures=captures, max_minutes=2)
    assert [cell.id for cell in plan.cells] == [
        "one/m/seed0",
        "two/m/seed0",
        "one/a/seed0",
        "two/a/seed0",
        "one/a/seed1",
        "two/a/seed1",
    ]
    with pytest.raises(ConfigError, match="rows are a, m"):
        make_plan(suite, BenchFolder(tmp_path), captures=captures, only=["b"])
    with pytest.raises(ConfigError, match="--captures: two captures are named one"):
        make_plan(suite, BenchFolder(tmp_path), captures=[captures[0], captures[0]])


def test_a_row_has_its_own_number_of_steps_unless_the_bench_is_given_one(tmp_path, tiny_capture):
    suite = read_suite(
        write(
            tmp_path,
            "name: s\niterations: 40\nrows: [{name: a, method: paper}, "
            "{name: b, method: paper, iterations: 10}, {name: m, method: median_background}]",
        )
    )

    captures = [tiny_capture("one")]

    def steps(**options) -> dict[str, tuple[int | None, float | None]]:
        plan = make_plan(suite, BenchFolder(tmp_path), captures=captures, **options)
        return {cell.row: (cell.iterations, cell.max_minutes) for cell in plan.cells}

    assert steps() == {"a": (40, None), "b": (10, None), "m": (None, None)}
    assert steps(iterations=7) == {"a": (7, None), "b": (7, None), "m": (None, None)}
    assert steps(max_minutes=2) == {"a": (None, 2), "b": (None, 2), "m": (None, None)}
    both = steps(max_minutes=2, iterations=7)
    assert both == {"a": (7, 2), "b": (7, 2), "m": (None, None)}


@pytest.mark.parametrize("lens, fits", [("none", True), ("fisheye", False)])
def test_a_new_option_at_its_default_leaves_staged_captures_what_they_were(
    tmp_path, monkeypatch, lens, fits
):
    @dataclass(frozen=True)
    class LaterSettings(StageSettings):
        lens: str = "none"

    def fingerprint(settings: StageSettings) -> str:
        capture = SuiteCapture("kick", stage=settings)
        suite = replace(read_suite(write(tmp_path, f"name: s\n{ROW}")), captures=(capture,))
        return make_plan(suite, BenchFolder(tmp_path)).sources["kick"].fingerprint

    before = fingerprint(StageSettings(motion="kick", width=64))
    monkeypatch.setattr(planning, "StageSettings", LaterSettings)
    after = fingerprint(LaterSettings(motion="kick", width=64, lens=lens))
    assert (before == after) == fits
    assert before != fingerprint(LaterSettings(motion="kick", width=96))


def test_a_seed_that_is_named_twice_is_one(tmp_path):
    assert read_suite(write(tmp_path, f"name: s\nseeds: [0, 1, 0]\n{ROW}")).seeds == (0, 1)


@pytest.mark.parametrize("added", ["theirs", "theirs=", "=theirs", "theirs=absent"])
def test_pictures_without_a_folder_are_not_those_of_the_working_directory(tmp_path, added):
    suite = read_suite(write(tmp_path, f"name: s\ncaptures: [{{name: c, path: c}}]\n{ROW}"))
    with pytest.raises(ConfigError, match=f"--add {added}: expected NAME=FOLDER"):
        make_plan(suite, BenchFolder(tmp_path), add=(added,))
