"""Exit codes and last words, whatever ends the work."""

import errno
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError

from evsplat.cli import main
from evsplat.cli.exits import exit_code
from evsplat.errors import DataError, OutputError
from evsplat.shipped import demo_capture


def raising(error: BaseException):
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/x"),
            "/x: not written, the disk is full",
        ),
        (OSError(errno.EIO, "Input/output error"), "Input/output error."),
        (MemoryError(), "Memory is full (no more to be had); close"),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:118] err == 0."), "Memory is full ([enforce"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "Memory is full (CUDA out"),
        (
            SafetensorError("header too large"),
            "A file of tensors cannot be read or written (header",
        ),
    ],
)
def test_what_the_machine_does_is_one_sentence_and_a_file(
    capsys, monkeypatch, tmp_path, error, said
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert exit_code(raising(error)) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"evsplat: {said}") and told.count("\n") == 1
    (file,) = tmp_path.iterdir()
    assert f"The traceback is in {file}." in told and "in work" in file.read_text()


def test_where_no_traceback_can_be_kept_the_sentence_stays(capsys, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/nowhere/at/all")
    assert exit_code(raising(MemoryError("so much"))) == 2
    assert capsys.readouterr().err.endswith("fewer frames.\n")


@pytest.mark.parametrize("error", [DataError("a: b."), OutputError("a: b.")])
def test_what_is_expected_needs_no_traceback(capsys, error):
    assert exit_code(raising(error)) == 2
    assert capsys.readouterr().err == "evsplat: a: b.\n"


SAID = "standard output: not written, the disk is full; make room there or write elsewhere."
has_full = pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="no device that is always full"
)


@has_full
def test_standard_output_that_is_full_is_one_sentence_of_the_process():
    command = [sys.executable, "-m", "evsplat", "--version"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, f"evsplat: {SAID}\n")


@has_full
@pytest.mark.parametrize("arguments", [["settings"], ["stage", "--list"]])
def test_standard_output_that_is_full_is_one_sentence_of_a_verb(arguments, monkeypatch, capsys):
    with open("/dev/full", "w") as full, open(os.devnull, "w") as nowhere:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(arguments) == 2
        os.dup2(nowhere.fileno(), full.fileno())  # where what is still buffered goes
    assert capsys.readouterr().err == f"evsplat: {SAID}\n"


def test_without_standard_output_the_work_is_done(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert exit_code(lambda: print("to nobody")) == 0


def test_a_fault_of_the_program_is_not_hidden():
    with pytest.raises(RuntimeError, match="shapes"):
        exit_code(raising(RuntimeError("shapes do not match")))


def test_sigterm_ends_the_work_as_ctrl_c_does(capsys):
    before = signal.getsignal(signal.SIGTERM)
    assert exit_code(lambda: os.kill(os.getpid(), signal.SIGTERM)) == 130
    assert capsys.readouterr().err == "\nevsplat: Stopped.\n"
    assert signal.getsignal(signal.SIGTERM) is before


LOST = """
import os, signal, sys, time
from evsplat.cli import main
from evsplat.cli.exits import exit_code

class Held:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass

def work():
    held = Held()
    del held
    time.sleep(30)

sys.exit(exit_code(work))
"""


def test_ctrl_c_that_python_drops_is_heard_all_the_same():
    done = subprocess.run([sys.executable, "-c", LOST], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stderr) == (130, "\nevsplat: Stopped.\n")


class StoppedAgain:
    """Like a progress bar, which is closed when it is given back, with the traceback of a stop."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass


def test_a_second_ctrl_c_while_a_stop_is_told_has_no_words(capfd):
    def work() -> None:
        held = StoppedAgain()  # noqa: F841 - the traceback has it
        stop_here()

    dropped = sys.unraisablehook
    sys.unraisablehook = sys.__unraisablehook__  # in place of pytest's
    try:
        assert exit_code(work) == 130
    finally:
        sys.unraisablehook = dropped
    assert capfd.readouterr().err == "\nevsplat: Stopped.\n"


def stop_here() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):
        pass


def test_a_stop_that_a_library_made_an_error_of_is_a_stop(capsys):
    class Sequence:
        def __len__(self) -> int:
            return 1

        def __getitem__(self, place: int) -> float:
            stop_here()
            return 0.0

    def work() -> None:
        try:
            torch.tensor(Sequence())
        except ValueError as error:
            raise DataError(f"not readable ({error})") from None

    with pytest.raises(DataError, match="could not determine the shape"):
        work()
    assert exit_code(work) == 130
    assert capsys.readouterr().err == "\nevsplat: Stopped.\n"
    assert exit_code(raising(DataError("not readable"))) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_fails_after_a_stop_is_said(capsys):
    def work() -> None:
        try:
            stop_here()
        except KeyboardInterrupt:
            raise OutputError("x: not written, the disk is full.") from None

    assert exit_code(work) == 2
    assert capsys.readouterr().err == "evsplat: x: not written, the disk is full.\n"


def test_unwritable_output_is_said_before_the_work(tmp_path: Path, capsys):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file" / "in", tmp_path / ("x" * 300)):
        for command in (["train", "--out"], ["inspect", "--out"], ["stage"], ["restore", "--out"]):
            verb, *option = command
            capture = [] if verb == "stage" else [str(demo_capture())]
            assert main([verb, *capture, *option, str(out)]) == 2
            told = capsys.readouterr().err
            assert any(words in told for words in ("a file is where", "too long", "is no name"))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("verb", ["convert", "export", "evaluate"])
def test_a_name_that_is_too_long_is_one_sentence(verb: str, tmp_path: Path, capsys):
    """The system said so, with a traceback kept."""
    long = tmp_path / ("x" * 300)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").touch()
    (tmp_path / "e.csv").write_text("t,x,y,p\n")
    before = sorted(tmp_path.rglob("*"))
    arguments = {
        "convert": ["convert", str(tmp_path / "e.csv"), f"{long}.h5"],
        "export": ["export", str(tmp_path / "run"), "avatar", "--out", str(long)],
        "evaluate": ["evaluate", str(long)],
    }[verb]
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.endswith(": the name is too long for this disk; choose a shorter one.\n")
    assert told.count("\n") == 1 and str(long) in told
    assert sorted(tmp_path.rglob("*")) == before
