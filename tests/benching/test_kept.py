"""Records that are kept: a bench starts from them, and what is published says where it is from."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import evsplat as ev
from evsplat.benching import origin
from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.kept import compact, plan_of_kept
from evsplat.benching.plan import make_plan
from evsplat.benching.suite import read_suite
from evsplat.benching.tables import make_tables, origins
from evsplat.errors import ConfigError
from evsplat.evaluation.tables import markdown
from evsplat.pages import read_rgb

from ..conftest import write_tiny_capture
from .helpers import MEDIAN, PAPER, cells_in_this_process, records, write_suite

OWN = {"name": "own", "method": "own_picture"}


@dataclass(frozen=True)
class Made:
    suite: Path
    folder: Path
    kept: Path


@pytest.fixture(scope="module", autouse=True)
def _cells() -> Iterator[None]:
    with cells_in_this_process():
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    """A bench that all tests look at, and none writes to."""
    place = tmp_path_factory.mktemp("made")
    capture = write_tiny_capture(place / "one")
    suite = write_suite(place / "suite.yaml", {"one": capture}, MEDIAN, PAPER)
    folder = ev.bench(suite, out=place / "out", records=place / "kept", jobs=1)
    return Made(suite, folder, place / "kept")


@pytest.fixture
def kept(made, tmp_path) -> Path:
    """A copy of its records."""
    return Path(shutil.copytree(made.kept, tmp_path / "kept"))


def test_what_is_kept_is_not_made_again_and_gives_the_same_tables(made, kept, tmp_path):
    first = made.folder
    second = ev.bench(made.suite, out=tmp_path / "second", records=kept, jobs=1)
    assert not (second / "cells").exists() and not (second / "runs").exists()
    assert (first / "tables.md").read_text() == (second / "tables.md").read_text()
    assert "pictures not kept" not in (second / "tables.md").read_text()
    assert not list((second / "strips").glob("*")) if (second / "strips").exists() else True


def test_a_kept_record_has_the_figures_of_every_frame_in_a_few_kb(made):
    whole = records(made.folder)["one/paper/seed0.json"]
    path = made.kept / "one" / "paper" / "seed0.json"
    kept = json.loads(path.read_text())
    assert path.stat().st_size < 9_000
    assert kept["cell"] == whole["cell"] and kept["train_cpu_seconds"] > 0
    assert [f["frame"] for f in kept["per_frame"]] == [f["frame"] for f in whole["per_frame"]]
    for short, long in zip(kept["per_frame"], whole["per_frame"], strict=True):
        for region, values in short["protocols"]["standard"].items():
            for name, value in values.items():
                long_value = long["protocols"]["standard"][region][name]
                assert value == pytest.approx(long_value, rel=1e-6)
    assert compact(kept) == kept


def test_a_kept_record_that_was_asked_for_otherwise_is_an_error_not_a_mixture(made, kept, tmp_path):
    with pytest.raises(ConfigError, match=r"kept.*iterations 12.*choose another --records"):
        ev.bench(made.suite, out=tmp_path / "other", records=kept, jobs=1, iterations=13)


def test_tables_are_made_of_kept_records_alone(made, tmp_path):
    suite, folder = read_suite(made.suite), BenchFolder(made.folder)
    from_bench = Records.read(make_plan(suite, folder), folder)
    nowhere = BenchFolder(tmp_path / "nowhere", made.kept)
    alone = Records.read(plan_of_kept(suite, suite.name, made.kept), nowhere)
    # Kept figures have seven digits, printed ones fewer.
    printed = [markdown("", "", make_tables(read)) for read in (alone, from_bench)]
    assert printed[0] == printed[1]


def test_rows_of_other_commits_are_told_apart(made, kept, tmp_path):
    path = kept / "one" / "paper" / "seed0.json"
    record = json.loads(path.read_text()) | {"code": {"commit": "abc1234", "date": "2026-01-02"}}
    path.write_text(json.dumps(record))
    newer = path.with_name("seed1.json")
    cell = record["cell"] | {"seed": 1}
    code = {"commit": "def5678", "date": "2026-02-03"}
    newer.write_text(json.dumps(record | {"cell": cell, "code": code}))
    suite = replace(read_suite(made.suite), seeds=(0, 1))
    nowhere = BenchFolder(tmp_path / "nowhere", kept)
    found = Records.read(plan_of_kept(suite, suite.name, kept), nowhere)
    assert origins(found)[0] == (
        "Code: abc1234 of 2026-01-02 (paper), def5678 of 2026-02-03 (paper)."
    )
    assert origins(found)[1].startswith("Trained on ")


def test_the_commit_is_the_last_one_that_changed_what_decides_figures(tmp_path, monkeypatch):
    def git(*words: str) -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        done = subprocess.run(
            ["git", "-C", tmp_path, *who, *words], check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    package = tmp_path / "src" / "evsplat"
    (package / "view").mkdir(parents=True)
    for name in ("__init__.py", "model.py", "view/page.py"):
        (package / name).write_text("one")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "one")
    first = git("log", "-1", "--format=%h")
    monkeypatch.setattr(origin, "_ROOT", tmp_path)
    (package / "view" / "page.py").write_text("two")
    git("commit", "-qam", "a view changes no figure")
    assert origin.code.__wrapped__()["commit"] == first
    (package / "model.py").write_text("two")
    assert origin.code.__wrapped__()["commit"] == first + "+"
    git("commit", "-qam", "a model does")
    assert origin.code.__wrapped__()["commit"] == git("log", "-1", "--format=%h")
    monkeypatch.setattr(origin, "_ROOT", tmp_path / "nowhere")
    assert origin.code.__wrapped__() is None


def test_the_cameras_own_picture_is_measured_and_does_not_compete(tiny_capture, tmp_path):
    capture = tiny_capture("one")
    suite = write_suite(tmp_path / "suite.yaml", {"one": capture}, MEDIAN, OWN)
    folder = ev.bench(suite, out=tmp_path / "out", jobs=1)
    drawn = sorted((folder / "runs" / "one" / "own" / "seed0" / "pictures").glob("*_render.png"))
    test = ev.load_capture(capture).test_frames
    recorded = [read_rgb(frame.image, "") for frame in test]
    assert all((read_rgb(a, "") == b).all() for a, b in zip(drawn, recorded, strict=True))
    found = Records.read(make_plan(read_suite(suite), BenchFolder(folder)), BenchFolder(folder))
    own = next(row for row in make_tables(found)[0].rows if row.title == "own")
    assert not any(figure.competes for figure in own.figures if figure)
