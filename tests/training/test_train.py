"""A training run as a user meets it: reproducible, resumable, honest when it fails."""

import json
import logging
import os
import re
import shutil
import signal
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save_file

from evsplat.cli import main
from evsplat.config import load_yaml, to_dict
from evsplat.config_docs import save_yaml
from evsplat.errors import BackendError, ConfigError, DataError
from evsplat.evaluation.run import evaluate_and_report
from evsplat.export import export_run, render_run
from evsplat.methods import TRAINABLE, method_config
from evsplat.training import load_run, train
from evsplat.training.bad_steps import MAX_BAD_STEPS
from evsplat.training.checkpoint import latest_checkpoint, load_checkpoint
from evsplat.training.clock import Clock
from evsplat.training.run import RunFolder, _settings_of, read_config
from evsplat.training.train import _ended
from evsplat.training.trainer import Trainer
from evsplat.untrusted.text import read_json

from ..conftest import write_tiny_capture
from ..own_process import errors_of, start
from ..seen import seen
from ..small_model import FILL, built, small


def wait_for_step(out: Path, step: int, process: BaseProcess) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        found = latest_checkpoint(out / "checkpoints")
        if found is not None and int(found.stem) >= step:
            return
        assert process.is_alive(), errors_of(out).read_text()
        time.sleep(0.005)
    raise AssertionError("no checkpoint in time")


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory) -> Path:
    """A folder with a capture and two steps on it, for tests that ask what becomes of a run."""
    place = tmp_path_factory.mktemp("trained")
    capture = write_tiny_capture(place / "tiny")
    train(capture, out=place / "run", iterations=2, overrides=small("evsplat"))
    return place


@pytest.fixture
def trained(trained_once, tmp_path) -> tuple[Path, Path]:
    """Its capture, and a run that the test may spoil."""
    return trained_once / "tiny", shutil.copytree(trained_once / "run", tmp_path / "my run")


def final_tensors(out: Path) -> dict[str, torch.Tensor]:
    path = latest_checkpoint(out / "checkpoints")
    assert path is not None
    return load_checkpoint(path)[0]


def log_without_times(out: Path) -> list[dict]:
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


def test_a_run_that_is_read_once_gives_the_files_that_its_folder_gives(trained, tmp_path):
    _, run = trained
    held = {"at": 0.1, "path": "swing", "seconds": 0.2, "fps": 20, "size": 48}
    moving = {"path": "orbit", "seconds": 0.2, "fps": 20, "size": 48}

    def made(given, folder):
        for name, film in (("held", held), ("moving", moving)):
            render_run(given, out=folder / name, **film)
        export_run(given, "avatar", out=folder / "avatar.html")
        metrics, report = evaluate_and_report(given)
        metrics.pop("evaluate_seconds")
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return [path.read_bytes() for path in files], metrics, report

    from_folder = made(run, tmp_path / "folder")
    assert len(from_folder[0]) == 11
    assert made(load_run(run), tmp_path / "loaded") == from_folder


def test_one_frame_trains_in_every_step(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """There is no motion between its key pose and another, whose price was not a number."""
    capture = write_tiny_capture(tmp_path / "tiny", frames=1)
    with caplog.at_level(logging.WARNING):
        train(
            capture,
            out=tmp_path / "run",
            iterations=3,
            overrides=small("evsplat", "pose.start=0"),
        )
    assert not [message for message in caplog.messages if "not finite" in message]
    assert all(bool(one.isfinite().all()) for one in final_tensors(tmp_path / "run").values())
    load_run(tmp_path / "run")
    told = [message for message in caplog.messages if "no test frame" in message]
    assert len(told) == 1, "reading the run says it no more"


@pytest.mark.parametrize(
    ("method", "settings"), [("paper", ()), ("evsplat", (FILL,))], ids=["paper", "evsplat"]
)
def test_killed_and_resumed_run_equals_the_uninterrupted_one_bit_for_bit(
    method, settings, tiny_capture, tmp_path
):
    """Killed twice, gone on both times; only the processes that are killed save after each step."""
    capture, settings = tiny_capture(frames=10), small(method, *settings)
    asked = {"iterations": 24, "threads": 1}
    train(capture, out=tmp_path / "whole", method=method, overrides=settings, **asked)
    broken = tmp_path / "broken"
    for kill_at, how in ((3, {"method": method, "settings": settings}), (13, {"resume": True})):
        process = start(capture, broken, asked["iterations"], **how)
        wait_for_step(broken, kill_at, process)
        process.kill()  # SIGKILL: nothing can be tidied up
        process.join()
    train(capture, out=broken, resume=True, **asked)
    expected, found = final_tensors(tmp_path / "whole"), final_tensors(broken)
    assert expected.keys() == found.keys()
    different = [name for name in expected if not torch.equal(expected[name], found[name])]
    assert different == []
    assert log_without_times(broken) == log_without_times(tmp_path / "whole")


def test_ctrl_c_finishes_the_step_saves_and_says_how_to_resume(tiny_capture, tmp_path):
    capture = tiny_capture(frames=10)
    out = tmp_path / "run"
    process = start(capture, out, 5_000, method="paper", settings=small("paper"))
    wait_for_step(out, 2, process)
    os.kill(process.pid, signal.SIGINT)
    process.join(60)
    assert process.exitcode not in (None, 0)
    assert f"--out {out} --resume" in errors_of(out).read_text()
    assert load_run(out).iteration >= 2


def test_ctrl_c_after_the_last_step_stops_before_the_evaluation(
    tiny_capture, tmp_path, monkeypatch, capsys
):
    """What ends a training takes seconds, and a Ctrl-C in them had no effect."""
    ending = Trainer.ending

    def interrupted(self):
        os.kill(os.getpid(), signal.SIGINT)
        return ending(self)

    monkeypatch.setattr(Trainer, "ending", interrupted)
    capture, out = tiny_capture(frames=10), tmp_path / "run"
    asked = ["train", str(capture), "--out", str(out), "--iterations", "2"]
    assert main([*asked, "--set", *small("evsplat")]) == 130
    assert f"Go on with: evsplat train {capture} --out {out} --resume" in capsys.readouterr().err
    assert load_run(out).iteration == 2 and not (out / "metrics.json").exists()


def test_a_finished_run_goes_on_where_more_steps_are_asked_for(tiny_capture, tmp_path):
    capture = tiny_capture(frames=10)
    out = train(capture, out=tmp_path / "run", iterations=4, overrides=small("evsplat"))
    train(capture, out=out, resume=True)
    assert load_run(out).iteration == 4
    train(capture, out=out, resume=True, iterations=8)
    assert load_run(out).iteration == 8
    _, state = load_checkpoint(latest_checkpoint(out / "checkpoints"))
    assert state["clock"]["iterations"] == 8 and state["clock"]["fraction"] == 1.0


def test_a_training_says_why_it_ended_and_how_it_goes_on(tiny_capture, tmp_path, caplog):
    capture = tiny_capture(frames=10)
    with caplog.at_level(logging.INFO):
        out = train(capture, out=tmp_path / "run", iterations=4, overrides=small("evsplat"))
    again = f"To go on: evsplat train {capture} --out {out} --resume --iterations 8"
    assert f"training ended after 4 steps: its schedule is finished. {again}" in caplog.text
    late = _ended(Clock(9, max_seconds=1.0, iteration=3, fraction=1 / 3), capture, out)
    assert "after 3 steps: the time that it was given is over. To go on: evsplat train" in late


def test_two_runs_with_one_seed_are_equal_and_another_seed_differs(tiny_capture, tmp_path):
    capture = tiny_capture(frames=10)
    runs = {}
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        out = train(
            capture, out=tmp_path / name, iterations=6, overrides=small("evsplat"), seed=seed
        )
        runs[name] = final_tensors(out)["model.gaussians.means"]
    assert torch.equal(runs["a"], runs["b"])
    assert not torch.equal(runs["a"], runs["c"])


@pytest.mark.parametrize("mode", ["fixed", "ste", "rendered"])
def test_every_semantics_mode_trains_and_only_learning_modes_move_labels(
    mode, tiny_capture, tmp_path
):
    capture = tiny_capture(frames=10)
    out = train(
        capture,
        method="paper",
        out=tmp_path / mode,
        iterations=12,
        overrides=small("paper", f"semantics={mode}"),
    )
    labels = final_tensors(out)["model.gaussians.semantic_logits"]
    moved = bool((labels.abs() != 2.0).any())
    assert moved == (mode != "fixed")


def test_random_cube_is_selectable(tiny_capture, tmp_path):
    out = train(
        tiny_capture(frames=10),
        method="paper",
        out=tmp_path / "run",
        iterations=6,
        overrides=small("paper", "scene.kind=random_cube", "scene.cube_count=300"),
    )
    run = load_run(out)
    assert run.gaussians["scene"] > 0
    picture = run.reconstruction.render(run.capture.camera(run.capture.frames[0]), [10_000])
    assert bool(picture.rgb.isfinite().all())


def test_a_training_brings_no_compiler_along(tiny_capture, tmp_path):
    """PyTorch imports it, which takes a second, for gradients of more than plain sums."""
    out, asked = tmp_path / "run", {"method": "evsplat", "settings": small("evsplat", FILL)}
    process = start(tiny_capture(frames=10), out, 3, without=("sympy", "torch._dynamo"), **asked)
    process.join(120)
    assert process.exitcode == 0, errors_of(out).read_text()


def test_non_finite_steps_are_skipped_counted_and_finally_stop(tiny_capture, caplog):
    capture = tiny_capture(frames=10)
    composition = built("paper", capture)
    trainer = Trainer(composition, seen(capture), Clock(100))
    assert trainer.step() is not None
    before = composition.model.skinning.mlp.weights[0].detach().clone()
    with torch.no_grad():
        composition.model.gaussians.features[0] = float("nan")
    for _ in range(MAX_BAD_STEPS - 1):
        assert trainer.step() is None
    assert trainer.bad.skipped == MAX_BAD_STEPS - 1
    assert torch.equal(composition.model.skinning.mlp.weights[0], before)
    assert "l1" in caplog.text
    with pytest.raises(DataError, match="steps in a row"):
        trainer.step()


def test_wrong_calls_are_refused_before_anything_is_written(tiny_capture, tmp_path):
    capture = tiny_capture(frames=10)
    out, config = tmp_path / "run", tmp_path / "config.yaml"
    config.write_text("policy:\n")
    calls = [
        ({"method": "papr"}, ConfigError, "Did you mean paper"),
        ({"iterations": 0}, ConfigError, "--iterations 0"),
        ({"max_minutes": -1.0}, ConfigError, "--max-minutes -1"),
        ({"device": "cuda"}, BackendError, "--device cuda"),
        ({"device": "gpu"}, ConfigError, "expected one of auto, cpu, cuda"),
        ({"overrides": ("event_wieght=1",)}, ConfigError, "Did you mean event_weight"),
        ({"seed": 2**64}, ConfigError, "--seed 18446744073709551616: expected an integer within"),
        ({"resume": True}, DataError, "not a run folder"),
        ({"config": config, "use": "everything"}, ConfigError, "policy is None; expected a sect"),
    ]
    for arguments, kind, message in calls:
        with pytest.raises(kind, match=message):
            train(capture, out=out, **arguments)
        assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    with pytest.raises(ConfigError, match="not empty"):
        train(capture, out=out)


def test_the_folder_above_a_run_names_the_run(tmp_path):
    (tmp_path / "runs" / "evsplat").mkdir(parents=True)
    with pytest.raises(DataError, match=r"runs: not a run folder, config.yaml is missing\.$"):
        read_config(RunFolder(tmp_path / "runs"))
    (tmp_path / "runs" / "evsplat" / "config.yaml").touch()
    with pytest.raises(DataError, match=r"missing\. A run lies below: .*runs/evsplat\.$"):
        read_config(RunFolder(tmp_path / "runs"))


@pytest.mark.parametrize("change", ["lacks", "holds the unknown"])
def test_a_checkpoint_of_another_version_is_named(trained, change):
    capture, out = trained
    path = latest_checkpoint(RunFolder(out).checkpoints)
    tensors, state = load_checkpoint(path)
    if change == "lacks":
        del tensors["model.sensor.offset"]
    else:
        tensors["model.sensor.gain"] = torch.zeros(1)
    save_file(tensors, path, metadata={"state": json.dumps(state)})
    name = "sensor.offset" if change == "lacks" else "sensor.gain"
    told = f"{change} {name}, being written by another version"
    with pytest.raises(DataError, match=told):
        load_run(out)
    log = RunFolder(out).log.read_text()
    with pytest.raises(DataError, match=told):
        train(capture, out=out, iterations=4, resume=True)
    assert RunFolder(out).log.read_text() == log


def test_a_damaged_checkpoint_is_named(trained):
    out = trained[1]
    path = latest_checkpoint(RunFolder(out).checkpoints)
    assert path is not None
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(DataError, match="not a readable checkpoint"):
        load_run(out)


@pytest.mark.parametrize(
    ("named", "method", "expected"),
    [(None, None, "evsplat"), ("paper", None, "paper"), ("paper", "evsplat", "evsplat")],
)
def test_the_method_is_the_one_asked_for_or_that_of_the_config(
    tiny_capture, tmp_path, named, method, expected
):
    config = None
    if named is not None:
        config = tmp_path / "config.yaml"
        config.write_text(f"method: {named}\n")
    out = train(
        tiny_capture(frames=10),
        method=method,
        out=tmp_path / "run",
        iterations=1,
        config=config,
        overrides=small(expected),
    )
    assert read_config(RunFolder(out))[0] == expected


def test_a_run_folder_holds_what_it_was_made_with(trained, tmp_path):
    capture, out = trained
    facts = json.loads((out / "versions.json").read_text())
    assert facts["packages"]["torch"] == torch.__version__
    assert facts["seed"] == 0 and facts["threads"] >= 1
    again = train(capture, out=tmp_path / "again", iterations=2, config=out / "config.yaml")
    assert torch.equal(
        final_tensors(out)["model.gaussians.means"], final_tensors(again)["model.gaussians.means"]
    )


def test_everything_trains_where_it_is_asked_for_and_no_figure_is_made(
    tiny_capture, tmp_path, capsys
):
    path, out = tiny_capture(frames=10), tmp_path / "run"
    settings = ["--set", *small("paper")]
    command = ["train", str(path), "--out", str(out), "--iterations", "12", "--method", "paper"]
    assert main([*command, "--use", "everything", *settings]) == 0
    assert "No test figures. Every frame and every event trained" in capsys.readouterr().out
    assert load_yaml(out / "config.yaml")["policy"]["use"] == "everything"
    run = load_run(out)
    assert len(run.capture.train_frames) == 10 and run.policy.use == "everything"
    assert len(run.reconstruction.model.latents.values) == 10
    metrics = read_json(out / "metrics.json")
    assert metrics["per_frame"] == [] and metrics["policy"]["use"] == "everything"
    assert metrics["protocols"]["standard"]["full"]["psnr"] is None
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "trained on every frame and every event" in page
    assert main(["train", str(path), "--out", str(out), "--resume", "--use", "training"]) == 2
    assert "--use" in capsys.readouterr().err


def test_a_run_of_the_version_before_says_what_became_of_its_settings(trained):
    capture, out = trained
    config = load_yaml(out / "config.yaml")
    config["deform"] = {"width": config.pop("width"), "shadow_lights": config.pop("lamps")}
    config["optimisation"] = {"iterations": config.pop("iterations")}
    config["windows"] = {"start": config.pop("event_start")}
    (out / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    for read in (lambda: load_run(out), lambda: train(capture, out=out, resume=True)):
        with pytest.raises(ConfigError) as error:
            read()
        told, advice = str(error.value).split("\n")
        for part in (
            f"{out / 'config.yaml'}: ",
            "deform.shadow_lights: renamed to lamps",
            "optimisation.iterations: renamed to iterations",
            "windows: its settings are event_start, ",
        ):
            assert part in told
        assert "versions.json beside it names it" in advice and "train again" in advice


@pytest.mark.parametrize("method", list(TRAINABLE))
def test_settings_read_back_have_the_digest_of_those_that_were_written(tmp_path, method):
    config = method_config(method, {}, where="defaults")
    save_yaml(tmp_path / "config.yaml", config, method=method)
    written = _settings_of({"method": method, **to_dict(config)})
    assert _settings_of(load_yaml(tmp_path / "config.yaml")) == written


def test_settings_edited_after_the_start_are_refused(trained, capsys):
    capture, out = trained
    path = out / "config.yaml"
    written = path.read_text()
    path.write_text("# a comment changes nothing\n" + written)
    train(capture, out=out, resume=True, iterations=3)
    path.write_text(re.sub("(?m)^event_weight: .*", "event_weight: 0.125", written))
    before = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    capsys.readouterr()
    assert main(["train", str(capture), "--out", str(out), "--resume", "--iterations", "4"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{path}: its settings are others than" in said
    assert f"evsplat train CAPTURE --config '{path}' --out NEW" in said
    assert before == {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    with pytest.raises(ConfigError, match="its settings are others"):
        load_run(out)
    path.write_text(written)
    assert load_run(out).iteration == 3


def longer_focal(document, body):
    document["cameras"]["main"]["K"][0][0] *= 1.1


def later_exposures(document, body):
    for frame in document["frames"]:
        frame["exposure_us"] = [time + 1000 for time in frame["exposure_us"]]


def backwards(document, body):
    body["poses"] = body["poses"][::-1]


def of_another_source(document, body):
    document["body"]["source"] = "estimated"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (longer_focal, "cameras has the digest .* learned by other cameras or exposure times"),
        (later_exposures, "cameras has the digest"),
        (backwards, "body has the digest .* learned by other poses or another body"),
        (of_another_source, "body has the digest"),
    ],
)
def test_a_run_is_not_drawn_by_other_cameras_and_poses(tiny_capture, tmp_path, change, said):
    path = tiny_capture()
    out = train(path, out=tmp_path / "run", iterations=1, overrides=small("evsplat"))
    write_changed(path, change)
    for read in (lambda: load_run(out), lambda: train(path, out=out, resume=True, iterations=2)):
        with pytest.raises(DataError, match=f"versions.json: {said}"):
            read()


def test_a_run_is_drawn_by_the_same_cameras_and_poses_written_otherwise(tiny_capture, tmp_path):
    path = tiny_capture()
    out = train(path, out=tmp_path / "run", iterations=1, overrides=small("evsplat"))

    def otherwise(document, body):
        for frame in document["frames"]:
            frame.pop("sharp", None)
        body["poses"] = body["poses"].astype(np.float64)

    write_changed(path, otherwise)
    assert load_run(out).iteration == 1


def test_a_run_that_goes_on_with_its_capture_elsewhere_is_drawn_from_there(tiny_capture, tmp_path):
    """It trained to the end, and then was refused as its capture was not at the old place."""
    path = tiny_capture()
    out = train(path, out=tmp_path / "run", iterations=1, overrides=small("evsplat"))
    moved = path.rename(tmp_path / "moved")
    train(moved, out=out, resume=True, iterations=2)
    assert load_run(out).capture.path == moved
    facts = read_json(out / "versions.json")
    assert facts["capture_name"] == load_run(out).capture.name and facts["seed"] == 0


def write_changed(path, change):
    """A capture with ``change`` made to what capture.json and body.npz hold."""
    document, body = (
        json.loads((path / "capture.json").read_text()),
        dict(np.load(path / "body.npz")),
    )
    change(document, body)
    (path / "capture.json").write_text(json.dumps(document))
    np.savez(path / "body.npz", **body)


@pytest.mark.parametrize("changed", ["capture", "policy"])
def test_what_was_trained_on_is_no_test_frame_later(tiny_capture, tmp_path, changed):
    path = tiny_capture(frames=10)
    use = "everything" if changed == "policy" else None
    out = train(path, out=tmp_path / "run", iterations=2, overrides=small("evsplat"), use=use)
    assert load_run(out).capture.name
    if changed == "policy":
        facts = read_json(out / "versions.json")
        del facts["settings"]  # of a version that did not record them
        (out / "versions.json").write_text(json.dumps(facts))
        settings = (out / "config.yaml").read_text()
        (out / "config.yaml").write_text(settings.replace("use: everything", "use: training"))
    else:
        document = json.loads((path / "capture.json").read_text())
        for frame in document["frames"]:
            frame["split"] = "test" if frame["split"] == "train" else "train"
        (path / "capture.json").write_text(json.dumps(document))
    for read in (lambda: load_run(out), lambda: train(path, out=out, resume=True, iterations=4)):
        with pytest.raises(DataError, match="what is held out may have been trained on"):
            read()
