"""Trainings that learn nothing end with a sentence; runs that were changed are not gone on with."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from evsplat.cli import main
from evsplat.errors import EvsplatError
from evsplat.evaluation.run import evaluate_run, write_report
from evsplat.methods import TRAINABLE
from evsplat.training import load_run, train
from evsplat.training.checkpoint import latest_checkpoint, load_latest
from evsplat.training.run import RunFolder

from ..conftest import write_event_file, write_tiny_capture
from ..small_model import small


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture and an evaluated run of two steps on it."""
    root = tmp_path_factory.mktemp("trained")
    capture = write_tiny_capture(root / "tiny")
    run = train(
        capture, out=root / "run", method="evsplat", overrides=small("evsplat"), iterations=2,
        any_body=True,
    )  # fmt: skip
    evaluate_run(run)
    return capture, run


@pytest.fixture
def run(trained: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the run to be spoilt."""
    return Path(shutil.copytree(trained[1], tmp_path / "run"))


def refused(call: Callable[[], object]) -> str:
    with pytest.raises(EvsplatError) as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("facts", ["[]", "{}", "null", '{"capture": 1}', '{"seed": "x"}', "["])
def test_facts_of_a_run_have_their_shape(trained, run, facts):
    (run / "versions.json").write_text(facts)
    for call in (lambda: load_run(run), lambda: train(trained[0], out=run, resume=True)):
        assert str(run / "versions.json") in refused(call)


def test_a_run_is_printed_in_a_few_words(trained):
    assert len(repr(load_run(trained[1]))) < 1000


def test_facts_that_are_gone_are_told_with_what_to_do(trained, run):
    (run / "versions.json").unlink()
    for call in (lambda: load_run(run), lambda: train(trained[0], out=run, resume=True)):
        said = f"{run / 'versions.json'}: file not found; restore the file, or train again."
        assert refused(call) == said


@pytest.mark.parametrize("metrics", ["[]", '{"capture": 1}'])
def test_a_report_of_other_figures_is_none(run, metrics):
    (run / "metrics.json").write_text(metrics)
    said = refused(lambda: write_report(run))
    assert "evaluate the run again" in said or "expected an object of JSON" in said
    assert not (run / "report.html").exists()


def test_a_report_shows_no_figures_of_an_earlier_step(trained, run):
    """Beside its clip, which the newest checkpoint draws."""
    train(trained[0], out=run, resume=True, iterations=3)
    said = refused(lambda: write_report(run))
    assert "metrics.json: iteration is 2, and the run's last checkpoint is of step 3" in said
    evaluate_run(run)
    assert write_report(run).is_file()


def change_state(run: Path, change: Callable[[dict[str, Any], dict[str, Any]], object]) -> None:
    path = latest_checkpoint(run / "checkpoints")
    assert path is not None
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        state = json.loads(file.metadata()["state"])
    change(tensors, state)
    save_file(tensors, path, metadata={"state": json.dumps(state)})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tensors, state: state.clear(), "state has no clock"),
        (lambda tensors, state: state.update(clock=[]), "state.clock is []"),
        (lambda tensors, state: state.update(human_count="x"), "state.human_count is 'x'"),
        (lambda tensors, state: state.update(human_count=10**9), "does not fit the capture"),
        (lambda tensors, state: state.pop("queue"), "state has no queue"),
        (lambda tensors, state: tensors.pop("generator"), "does not fit the capture"),
    ],
)
def test_a_checkpoint_that_was_changed_is_not_gone_on_with(trained, run, change, said):
    change_state(run, change)
    assert said in refused(lambda: train(trained[0], out=run, resume=True, iterations=4))


def test_a_run_goes_on_with_its_own_capture(trained, run, tmp_path):
    other = write_tiny_capture(tmp_path / "other", frames=10, width=40)
    said = refused(lambda: train(other, out=run, resume=True))
    assert "was trained on the capture 'tiny', and is to go on with 'other'" in said


def test_a_run_does_not_go_on_with_another_up(tmp_path):
    """Floor and light were learned by it; another length of the same axis is no other one."""
    capture, run = write_tiny_capture(tmp_path / "tiny"), tmp_path / "run"
    document = json.loads((capture / "capture.json").read_text())

    def write(**up: list[float]) -> None:
        (capture / "capture.json").write_text(json.dumps(document | up))

    write(up=[0, 0.1, 2])
    train(capture, out=run, iterations=1, overrides=small("evsplat"))
    write(up=[0, 0, 1])
    assert load_run(run).iteration == 1
    for other, found in (({"up": [0, 1, 0]}, "[0.0, 1.0, 0.0]"), ({}, "None")):
        write(**other)
        for call in (lambda: load_run(run), lambda: train(capture, out=run, resume=True)):
            said = refused(call)
            assert "versions.json: up is [0.0, 0.0, 1.0]" in said and f"has {found} now" in said


@pytest.mark.parametrize("method", [name for name, of in TRAINABLE.items() if not of.drawn_by_up])
def test_what_is_not_drawn_by_up_goes_on_with_another_bit_for_bit(tmp_path, method):
    """A scene may begin with a floor under the feet; what it became is in the checkpoint."""
    capture, run, same = write_tiny_capture(tmp_path / "tiny"), tmp_path / "run", tmp_path / "same"
    train(capture, out=run, method=method, iterations=2, overrides=small(method))
    shutil.copytree(run, same)
    train(capture, out=same, resume=True, iterations=3)
    document = json.loads((capture / "capture.json").read_text())
    (capture / "capture.json").write_text(json.dumps(document | {"up": [0, -1, 0]}))
    train(capture, out=run, resume=True, iterations=3)
    (_, tensors, _), (_, expected, _) = (
        load_latest(RunFolder(folder).checkpoints) for folder in (run, same)
    )
    assert tensors.keys() == expected.keys()
    assert all(torch.equal(tensors[name], expected[name]) for name in tensors)
    assert load_run(run).iteration == 3


def test_a_run_without_a_checkpoint_begins_its_log_anew(trained, run):
    shutil.rmtree(run / "checkpoints")
    (run / "log.jsonl").write_text('{"iteration": 10}\n{"iteration": 20}\n[]\n')
    train(trained[0], out=run, resume=True, iterations=2)
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [2]


@pytest.mark.parametrize("empty", [True, False])
def test_events_beside_the_time_of_the_frames_are_said_at_once(tmp_path, capsys, empty):
    """A warning of `inspect`, since they may be wanted for other frames; a training needs them."""
    capture = write_tiny_capture(tmp_path / "tiny")
    with h5py.File(capture / "events.h5", "r") as file:
        columns = [file[f"events/{name}"][()] for name in "txyp"]
    kept = columns[0] > (10**9 if empty else 320_000)  # none, or those of held-out frames
    write_event_file(capture / "events.h5", *[column[kept] for column in columns])
    out = tmp_path / "run"
    settings = [word for pair in small("evsplat") for word in ("--set", pair)]
    assert main(["train", str(capture), "--out", str(out), "--any-body", *settings]) == 2
    assert "holds no event that training may see" in capsys.readouterr().err
    assert not out.exists()
    out = train(
        capture, out=out, iterations=1, any_body=True,
        overrides=(*small("evsplat"), "event_weight=0"),
    )  # fmt: skip
    assert load_run(out).iteration == 1


def test_a_training_without_a_sound_step_saves_nothing(tmp_path, monkeypatch):
    capture = write_tiny_capture(tmp_path / "tiny")
    never = torch.tensor(False)
    monkeypatch.setattr(
        "evsplat.training.trainer.Optimiser.finite", lambda optimiser, *others: never
    )
    said = refused(
        lambda: train(
            capture,
            out=tmp_path / "run",
            iterations=3,
            any_body=True,
            overrides=small("evsplat"),
        )  # fmt: skip
    )
    assert "none of 3 steps gave a finite loss" in said
    assert latest_checkpoint(tmp_path / "run" / "checkpoints") is None
