"""A training and the machine under it: one at a time, signals, full disks, half-begun runs."""

import errno
import json
import logging
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch

from evsplat.cli import main
from evsplat.disk import held
from evsplat.errors import ConfigError, DataError, MachineError, OutputError
from evsplat.training import Stopped, load_run, loop, train
from evsplat.training.checkpoint import checkpoints
from evsplat.training.trainer import Trainer
from evsplat.training_sign import is_training
from evsplat.view.viewed_run import load_newest

from ..limits import files_of_at_most
from ..small_model import small
from .test_train import final_tensors

# The package has a function of the module's name.
MODULE = sys.modules["evsplat.training.train"]


def trained(capture: Path, out: Path, **options: object) -> Path:
    return train(capture, out=out, iterations=2, overrides=small("evsplat"), **options)


def test_a_second_training_in_one_folder_is_refused_and_changes_nothing(tiny_capture, tmp_path):
    capture, out = tiny_capture(), tmp_path / "run"
    out.mkdir()
    with held(out / ".watch"):
        assert is_training(out)
        told = f"run: process {os.getpid()} is training in this folder; wait for it or choose"
        with pytest.raises(ConfigError, match=told):
            trained(capture, out)
    assert {path.name for path in out.iterdir()} == {".watch"}
    trained(capture, out)  # the sign of a training that was killed is in nobody's way
    assert not (out / ".watch").exists()
    with pytest.raises(ConfigError, match="the folder is not empty; pass --resume"):
        trained(capture, out)


def test_a_refused_training_leaves_no_folder(tiny_capture, tmp_path):
    with pytest.raises(ConfigError):
        train(tiny_capture(), out=tmp_path / "a" / "run", overrides=["event_wieght=1"])
    with pytest.raises(DataError):
        train(tmp_path / "nothing", out=tmp_path / "a" / "run")
    assert not (tmp_path / "a").exists()


def test_sigterm_saves_as_ctrl_c_does(tiny_capture, tmp_path, monkeypatch):
    out, before = tmp_path / "run", signal.getsignal(signal.SIGTERM)
    step = Trainer.step

    def ended_in_a_step(trainer: Trainer) -> object:
        if trainer.clock.iteration == 2:
            assert is_training(out)
            os.kill(os.getpid(), signal.SIGTERM)
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", ended_in_a_step)
    with pytest.raises(Stopped, match=f"--out {out} --resume"):
        train(tiny_capture(), out=out, iterations=5_000, overrides=small("evsplat"))
    assert load_run(out).iteration == 3 and not is_training(out)
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_viewer_of_a_training_that_was_killed_before_its_first_checkpoint_ends(
    tiny_capture, tmp_path
):
    out = trained(tiny_capture(), tmp_path / "run")
    for path in checkpoints(out / "checkpoints"):
        path.unlink()
    (out / ".watch").touch()
    with pytest.raises(DataError, match="no checkpoint; train the run first"):
        load_newest(out, "cpu")


def test_a_run_without_a_checkpoint_is_begun_anew_with_an_empty_log(tiny_capture, tmp_path):
    capture = tiny_capture()
    whole = trained(capture, tmp_path / "whole")
    out = Path(shutil.copytree(whole, tmp_path / "run"))
    config = (out / "config.yaml").read_bytes()
    for path in checkpoints(out / "checkpoints"):
        path.unlink()
    train(capture, out=out, iterations=2, resume=True)
    lines = (out / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == [2]
    expected, found = final_tensors(whole), final_tensors(out)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert (out / "config.yaml").read_bytes() == config


def test_a_run_goes_on_from_before_a_damaged_checkpoint(
    tiny_capture, tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    capture = tiny_capture()
    options = {"iterations": 6, "overrides": small("evsplat")}
    whole = train(capture, out=tmp_path / "whole", **options)
    out = Path(shutil.copytree(whole, tmp_path / "run"))
    newest = checkpoints(out / "checkpoints")[-1]
    newest.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        assert load_run(out).iteration == 5
        train(capture, out=out, iterations=6, resume=True)
    assert "Taking the one before it." in caplog.text
    expected, found = final_tensors(whole), final_tensors(out)
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def fails_after_a_step(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    step, made = Trainer.step, []

    def failing(trainer: Trainer) -> object:
        if len(made) == 2:
            raise error
        made.append(1)
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", failing)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "Memory is full (no more to be had); close other programs"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "Memory is full (DefaultCPU"),
        (OSError(errno.EIO, "Input/output error", "events.h5"), "events.h5: Input/output error."),
    ],
)
def test_a_machine_that_fails_is_a_sentence_with_the_traceback_beside_the_run(
    tiny_capture, tmp_path, monkeypatch, capsys, error, said
):
    fails_after_a_step(monkeypatch, error)
    out = tmp_path / "run"
    settings = [f"--set={setting}" for setting in small("evsplat")]
    assert main(["train", str(tiny_capture()), "--out", str(out), *settings]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"evsplat: {said}") and "No checkpoint is kept" in told
    (file,) = out.glob("evsplat-traceback-*.txt")
    assert told.endswith(f"The traceback is in {file}.")
    assert "Traceback (most recent call last)" in file.read_text()


def test_the_traceback_of_a_training_that_never_began_is_in_nobodys_way(
    tiny_capture, tmp_path, monkeypatch
):
    capture, out = tiny_capture(), tmp_path / "run"
    command = ["train", str(capture), "--out", str(out), "--iterations", "2", "--no-evaluate"]
    command += [f"--set={setting}" for setting in small("evsplat")]

    def failing(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "config.yaml")

    with monkeypatch.context() as broken:
        broken.setattr(MODULE, "save_yaml", failing)
        assert main(command) == 2
    assert list(out.glob("evsplat-traceback-*.txt")) and not (out / "config.yaml").exists()
    assert main(command) == 0
    assert (out / "config.yaml").exists()


def test_a_fault_of_the_program_stays_one(tiny_capture, tmp_path, monkeypatch):
    fails_after_a_step(monkeypatch, RuntimeError("shapes do not match"))
    with pytest.raises(RuntimeError, match="shapes do not match") as caught:
        train(tiny_capture(), out=tmp_path / "run", overrides=small("evsplat"))
    assert not isinstance(caught.value, MachineError)


def test_without_room_nothing_is_fitted(tiny_capture, tmp_path, monkeypatch):
    usage = type("Usage", (), {"free": 1_000_000})
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
    monkeypatch.setattr(MODULE, "_trainer", lambda *_: pytest.fail("it was"))
    with pytest.raises(OutputError, match=r"run: 1\.0 MB are free on its disk, expected 3\.1 MB"):
        trained(tiny_capture(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_where_files_may_not_grow_the_training_ends_in_a_sentence(tiny_capture, tmp_path, capsys):
    out = tmp_path / "run"
    settings = [f"--set={setting}" for setting in small("evsplat")]
    command = ["train", str(tiny_capture()), "--out", str(out), "--iterations", "3", *settings]
    with files_of_at_most(30_000):
        assert main(command) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "000003.safetensors: not written, files may not grow so large here" in told
    assert told.endswith("No checkpoint is kept: once that is mended, train again.")
    assert not list((out / "checkpoints").glob("*")) and not (out / ".watch").exists()
