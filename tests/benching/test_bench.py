"""A bench that is killed, fails in places or is asked again ends with the same table."""

import json
import os
import random
import shlex
import shutil
import signal
import time
from dataclasses import asdict
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

import evsplat as ev
from evsplat.benching.cell import run_cell
from evsplat.benching.folder import BenchFolder, exclusive
from evsplat.benching.plan import make_plan
from evsplat.benching.suite import read_suite
from evsplat.capture import load_capture
from evsplat.capture.policy import Terms
from evsplat.cli import main
from evsplat.errors import ConfigError
from evsplat.evaluation import evaluate
from evsplat.restore import WEIGHT_FILES
from evsplat.training import load_run, loop
from evsplat.training.checkpoint import latest_checkpoint
from evsplat.training.trainer import Trainer
from evsplat.untrusted.text import read_json

from ..own_process import errors_of, start_bench
from ..small_model import SMALL
from .helpers import MEDIAN, PAPER, cells_in_this_process, records, write_suite


def wait_until_begun(lock: Path, process: BaseProcess, *, before: str) -> str:
    """The number of the process that does the cell, another than ``before``, or of none."""
    deadline = time.monotonic() + 300
    while process.is_alive():
        assert time.monotonic() < deadline
        number = lock.read_text() if lock.exists() else ""
        if number not in ("", before):
            return number
        time.sleep(0.01)
    return ""


def test_killed_at_random_moments_and_started_again_it_ends_with_the_same_records(
    tiny_capture, tmp_path
):
    rows = (PAPER | {"restore": "edi"},)
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, *rows)
    started = time.monotonic()
    with cells_in_this_process():
        ev.bench(suite, out=tmp_path / "whole", jobs=1)
    took = time.monotonic() - started
    seed = random.randrange(1 << 30)
    moments, worker = random.Random(seed), ""
    for _ in range(2):
        process = start_bench(suite, tmp_path / "killed")
        lock = BenchFolder(tmp_path / "killed").lock_of("one/paper/seed0")
        worker = wait_until_begun(lock, process, before=worker)
        process.join(moments.uniform(0, 0.9) * took)
        process.kill()
        process.join()
    with cells_in_this_process():
        ev.bench(suite, out=tmp_path / "killed", jobs=1)
    assert records(tmp_path / "killed") == records(tmp_path / "whole"), f"seed {seed}"
    hidden = [path.name for path in (tmp_path / "killed" / "captures").iterdir()]
    assert hidden == ["one-edi"]


def test_a_cell_that_died_goes_on_from_its_checkpoint(tiny_capture, tmp_path, monkeypatch):
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, PAPER)
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    step, seen = Trainer.step, []

    def counted(trainer, stop_at=None):
        seen.append(trainer.clock.iteration)
        if trainer.clock.iteration == stop_at:
            raise SystemExit("as if the process was killed")
        return step(trainer)

    def run(out: str) -> Path:
        folder = BenchFolder(tmp_path / out)
        (cell,) = make_plan(read_suite(suite), folder).cells
        run_cell(folder.path, cell, threads=1, device="cpu")
        return folder.path

    monkeypatch.setattr(Trainer, "step", counted)
    whole = run("whole")
    monkeypatch.setattr(Trainer, "step", lambda trainer: counted(trainer, stop_at=7))
    with pytest.raises(SystemExit):
        run("broken")
    assert not (tmp_path / "broken" / "cells").exists()
    seen.clear()
    monkeypatch.setattr(Trainer, "step", counted)
    assert records(run("broken")) == records(whole)
    assert seen == list(range(7, 12))


@pytest.mark.parametrize("settings", [["event_weight=0"], []])
def test_a_training_that_was_stopped_does_not_go_on_for_other_settings(
    tiny_capture, tmp_path, monkeypatch, settings
):
    capture, out = tiny_capture("one"), tmp_path / "out"
    other = PAPER | {"settings": [*PAPER["settings"], *settings]}
    first = write_suite(tmp_path / "suite.yaml", {"one": capture}, PAPER)
    folder, step = BenchFolder(out), Trainer.step
    (cell,) = make_plan(read_suite(first), folder).cells
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)

    def dies(trainer):
        if trainer.clock.iteration == 7:
            raise SystemExit("as if the process was killed")
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", dies)
    with pytest.raises(SystemExit):
        run_cell(folder.path, cell, threads=1, device="cpu")
    monkeypatch.setattr(Trainer, "step", step)
    changed = write_suite(tmp_path / "suite.yaml", {"one": capture}, other)
    with cells_in_this_process():
        if not settings:
            ev.bench(changed, out=out, jobs=1)
            assert records(out)["one/paper/seed0.json"]["iteration"] == 12
            return
        with pytest.raises(ConfigError, match=r"begun.*settings.*choose another --out"):
            ev.bench(changed, out=out, jobs=1)
        shutil.rmtree(folder.run_of(cell.id))
        ev.bench(changed, out=out, jobs=1)
    assert "event_weight=0" in records(out)["one/paper/seed0.json"]["cell"]["settings"]


def _staged(path: Path, seed: int, *rows: dict, **more: int) -> Path:
    """A suite with a staged capture ``one``, and one for each of ``more``, by name and seed."""
    seeds = {"one": seed} | {name.replace("_", "-"): other for name, other in more.items()}
    captures = [
        {"name": name, "stage": {"frames": 5, "width": 24, "seed": number}}
        for name, number in seeds.items()
    ]
    path.write_text(json.dumps({"name": "s", "captures": captures, "rows": rows}))
    return path


def test_a_staged_capture_is_not_taken_for_one_of_other_settings(tmp_path):
    seed, out = random.randrange(1 << 20), tmp_path / "out"
    rows = (MEDIAN, {"name": "nearest", "method": "nearest_frame"})
    with cells_in_this_process():
        ev.bench(_staged(tmp_path / "a.yaml", seed, *rows), out=out, only=("median",), jobs=1)
        suite = _staged(tmp_path / "b.yaml", seed + 1, *rows)
        ev.bench(suite, out=out, only=("nearest",), jobs=1)
    record = records(out)["one/nearest/seed0.json"]
    assert record["status"] == "failed", seed
    assert "was made by other settings or of another capture" in record["reason"]


def test_a_staged_capture_may_not_have_the_name_of_a_restored_one(tmp_path):
    row = {"name": "after-edi", "method": "paper", "restore": "edi"}
    suite = read_suite(_staged(tmp_path / "a.yaml", 0, row, one_edi=1))
    with pytest.raises(ConfigError, match="capture one-edi: .* row after-edi makes of capture one"):
        make_plan(suite, BenchFolder(tmp_path / "out"))
    assert make_plan(suite, BenchFolder(tmp_path / "out"), captures=(Path("one"),)).cells


def test_failures_are_recorded_kept_and_tried_again_only_when_asked(tiny_capture, tmp_path, capsys):
    rows = (MEDIAN, {"name": "new", "method": "of_tomorrow"})
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, *rows)
    out = tmp_path / "out"

    def bench(*options: str) -> int:
        with cells_in_this_process():
            return main(["bench", str(suite), "--out", str(out), *options])

    assert bench("--jobs", "1") == 0
    assert "0 done before" in capsys.readouterr().err
    first = records(out)
    assert first["one/median/seed0.json"]["status"] == "done"
    failed = first["one/new/seed0.json"]
    assert failed["status"] == "failed" and "of_tomorrow: unknown" in failed["reason"]
    for name in ("tables.md", "tables.tex", "index.html"):
        assert "unknown; methods are" in (out / name).read_text()

    assert bench() == 0
    assert "0 cells to do, 2 done before" in capsys.readouterr().err
    assert bench("--retry") == 0
    assert "1 cell to do, 1 done before" in capsys.readouterr().err
    assert records(out) == first

    write_suite(suite, {"one": tiny_capture("two")}, MEDIAN | {"method": "nearest_frame"})
    assert bench() == 2
    message = capsys.readouterr().err
    assert "was made with method 'median_background', and 'nearest_frame' is asked for" in message
    assert records(out) == first


def test_masks_that_rows_lack_are_told_before_anything_is_trained(tiny_capture, tmp_path, capsys):
    """With the command after which the suite reads the capture with masks."""
    path = tiny_capture("bare")
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        del frame["mask"]
    (path / "capture.json").write_text(json.dumps(document))
    hugs = {"name": "hugs", "method": "hugs", "settings": list(SMALL["hugs"])}
    captures = {"bare": path, "masked": tiny_capture("masked")}
    suite = write_suite(tmp_path / "suite.yaml", captures, MEDIAN, hugs, iterations=1)

    def bench(out: str) -> tuple[list[str], str]:
        with cells_in_this_process():
            assert main(["bench", str(suite), "--out", str(tmp_path / out), "--only", "hugs"]) == 0
        told = capsys.readouterr().err
        return [line for line in told.splitlines() if "make masks first" in line], told

    (sentence,), _ = bench("before")
    failed = records(tmp_path / "before")["bare/hugs/seed0.json"]
    assert "pass --set policy.masks=estimated. In a bench settings stand" in failed["reason"]
    assert sentence.startswith(f"{path / 'capture.json'}: 7 of 7 training frames have no mask")
    assert "these rows fail: hugs." in sentence
    words = shlex.split(sentence.partition("make masks first: ")[2])
    assert main(words[1:]) == 0
    told, said = bench("after")
    assert not told and "failed" not in said


def test_a_capture_that_changes_while_the_bench_runs_costs_the_cells_that_are_left(
    tiny_capture, tmp_path
):
    """As `evsplat masks --in-place` changes it: no record says of it what was asked of another."""
    capture = tiny_capture("one")
    suite = write_suite(
        tmp_path / "suite.yaml", {"one": capture}, MEDIAN, MEDIAN | {"name": "later"}
    )
    folder = BenchFolder(tmp_path / "out")
    before, after = make_plan(read_suite(suite), folder).cells
    run_cell(folder.path, before, threads=1, device="cpu")
    document = json.loads((capture / "capture.json").read_text())
    del document["frames"][0]["mask"]
    (capture / "capture.json").write_text(json.dumps(document))
    run_cell(folder.path, after, threads=1, device="cpu")
    assert read_json(folder.record_of(before.id))["status"] == "done"
    record = read_json(folder.record_of(after.id))
    assert record["status"] == "failed"
    assert record["reason"].startswith(f"{capture / 'capture.json'}: changed since this bench")


def test_weights_that_rows_lack_are_told_before_anything_is_trained(
    tiny_capture, tmp_path, monkeypatch, capsys
):
    """Once per restorer, with the rows; not where captures are restored already."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    monkeypatch.delenv(WEIGHT_FILES["mprnet"].variable, raising=False)
    capture = tiny_capture("one")
    restored = [
        {"name": f"{name}_{row}", "method": "nearest_frame", "restore": name}
        for name in ("mprnet", "edi")
        for row in "ab"
    ]
    suite = write_suite(tmp_path / "suite.yaml", {"one": capture}, MEDIAN, *restored)
    out = tmp_path / "out"

    def told(*more: str) -> list[str]:
        with cells_in_this_process():
            assert main(["bench", str(suite), "--out", str(out), *more]) == 0
        return capsys.readouterr().err.splitlines()

    lines = told()
    first = next(i for i, line in enumerate(lines) if line.startswith("[1/"))
    (sentence,) = [line for line in lines[:first] if "these rows fail" in line]
    assert "model_deblurring.pth" in sentence and WEIGHT_FILES["mprnet"].variable in sentence
    assert sentence.endswith("Without it these rows fail: mprnet_a, mprnet_b.")
    failed = [name for name, record in records(out).items() if record["status"] == "failed"]
    assert failed == ["one/mprnet_a/seed0.json", "one/mprnet_b/seed0.json"]

    shutil.copytree(capture, out / "captures" / "one-mprnet")
    assert not any("these rows fail" in line for line in told("--retry"))
    assert all(record["status"] == "done" for record in records(out).values())


def test_a_person_without_scene_can_be_measured_before_the_background(tiny_capture, tmp_path):
    row = {"name": "alone", "method": "avatar3dgs", "backdrop": True}
    settings = list(SMALL["avatar3dgs"])
    capture = tiny_capture("one")
    suite = write_suite(tmp_path / "suite.yaml", {"one": capture}, row | {"settings": settings})
    folder = BenchFolder(tmp_path / "out")
    (cell,) = make_plan(read_suite(suite), folder).cells
    run_cell(folder.path, cell, threads=1, device="cpu")
    record = read_json(folder.record_of(cell.id))
    assert record["status"] == "done", record
    trained = load_run(folder.run_of(cell.id))
    again = evaluate(
        load_capture(capture), trained.reconstruction, out_dir=tmp_path / "again", human_only=True
    )
    assert record["protocols"]["standard"] == again["composited"]["standard"]
    assert record["protocols"]["standard"]["full"] != again["protocols"]["standard"]["full"]


def test_two_benches_do_not_share_a_folder(tiny_capture, tmp_path):
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, MEDIAN)
    with (
        exclusive(BenchFolder(tmp_path / "out").lock_of("bench")),
        pytest.raises(ConfigError, match="another bench works in this folder"),
    ):
        ev.bench(suite, out=tmp_path / "out")


def test_ctrl_c_saves_and_says_how_to_go_on(tiny_capture, tmp_path):
    suite = write_suite(
        tmp_path / "suite.yaml", {"one": tiny_capture("one")}, PAPER, iterations=1_000_000
    )
    out = tmp_path / "out"
    process = start_bench(suite, out)
    run = out / "runs" / "one" / "paper" / "seed0"
    deadline = time.monotonic() + 300
    while not (run / "log.jsonl").exists():  # opened right before the first step
        assert time.monotonic() < deadline and process.is_alive()
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    process.join(300)
    errors = errors_of(out).read_text()
    assert process.exitcode == 130, errors
    assert "0 of 1 cells are done" in errors and f"evsplat bench {suite}" in errors
    assert latest_checkpoint(run / "checkpoints") is not None
    assert "1 of 1 cells have not been run yet" in (out / "tables.md").read_text()


def test_a_cell_is_made_by_its_own_policy_and_says_so(tiny_capture, tmp_path):
    settings = [*SMALL["paper"], "event_weight=0"]
    rows = [
        {"name": name, "method": "paper", "restore": "edi", "settings": [*settings, *policy]}
        for name, policy in (
            ("strict", ()),
            ("estimated", ("policy.thresholds=estimated",)),
            ("interpolated", ("policy.held_out_poses=interpolated",)),
        )
    ]
    path = tiny_capture("one", frames=20, width=64, height=48)
    suite = write_suite(tmp_path / "suite.yaml", {"one": path}, *rows, iterations=2)
    folder = BenchFolder(tmp_path / "out")
    cells = make_plan(read_suite(suite), folder).cells
    found = {}
    for cell in cells:
        run_cell(folder.path, cell, threads=1, device="cpu")
        record = read_json(folder.record_of(cell.id))
        assert record["status"] == "done", record
        found[cell.row] = record["policy"]
        of_events = {"events": True, "event_use": "amounts", "thresholds_found": True}
        assert found[cell.row] == {**record["cell"]["policy"], **of_events}
    assert found["strict"] == asdict(Terms())
    assert found["estimated"] == asdict(Terms(thresholds="estimated"))
    assert found["interpolated"] == asdict(Terms(held_out_poses="interpolated"))
    # EDI's thresholds are part of what it may see; poses are not
    names = {restored.name for restored in folder.captures.iterdir() if restored.is_dir()}
    assert names == {"one-edi", "one-edi-thresholds-estimated"}
    made = {name: load_capture(folder.captures / name).provenance["restored"] for name in names}
    origins = {name: restored["contrast_threshold_origin"] for name, restored in made.items()}
    assert origins["one-edi"] == "from the capture"
    assert origins["one-edi-thresholds-estimated"] == "estimated from the capture"


def test_a_row_that_trained_on_everything_is_not_measured(tiny_capture, tmp_path):
    row = {"name": "all", "method": "paper", "settings": ["policy.use=everything"]}
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, row)
    folder = BenchFolder(tmp_path / "out")
    (cell,) = make_plan(read_suite(suite), folder).cells
    run_cell(folder.path, cell, threads=1, device="cpu")
    record = read_json(folder.record_of(cell.id))
    assert record["status"] == "failed" and "nothing to measure" in record["reason"]
    assert "In a bench settings" not in record["reason"]
