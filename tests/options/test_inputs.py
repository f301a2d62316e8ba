"""Paths that lead nowhere are told at once."""

import subprocess
import sys
from pathlib import Path

import pytest

from evsplat.cli.main import main
from evsplat.disk import held
from evsplat.errors import DataError
from evsplat.options.inputs import (
    check_capture_folder,
    check_capture_or_recording,
    check_run_folder,
    check_run_or_training,
)

VERBS = [
    *(f"{verb} no" for verb in ("train", "evaluate", "report", "render", "view", "inspect")),
    *(f"{verb} no --out o" for verb in ("masks", "poses", "restore", "simulate", "synthesize")),
    "export no ply",
    "convert no out.h5",
    "trian no",
]


def test_a_path_that_leads_nowhere_is_told_without_loading_torch(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from evsplat.cli.main import main\n"
        f"for line in {VERBS!r}:\n"
        "    assert main(line.split()) == 2, line\n"
        "assert 'torch' not in sys.modules and 'numpy' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    told = done.stderr.splitlines()
    assert len(told) == len(VERBS)
    assert all(line.startswith(("evsplat: no: ", "evsplat: trian: ")) for line in told)
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_verb_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trian"]) == 2
    assert capsys.readouterr().err == (
        "evsplat: trian: no such verb; did you mean train? 'evsplat --help' lists all.\n"
    )


def test_a_second_run_is_checked_as_the_first(tmp_path: Path, capsys) -> None:
    (tmp_path / "config.yaml").touch()
    assert main(["view", str(tmp_path), str(tmp_path / "other")]) == 2
    assert f"{tmp_path}/other: not a run folder" in capsys.readouterr().err


def test_runs_one_level_below_are_named(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "config.yaml").touch()
    with pytest.raises(DataError, match=r"is missing\. A run lies below: .*/a\.$"):
        check_run_folder(tmp_path)


def test_a_capture_in_the_place_of_a_run_is_told_with_what_makes_one_of_it(tmp_path: Path) -> None:
    (tmp_path / "capture.json").touch()
    said = rf"{tmp_path}: a capture, expected a run; .*: evsplat train {tmp_path} --out RUN\.$"
    with pytest.raises(DataError, match=said):
        check_run_folder(tmp_path)


def test_a_training_that_prepares_its_first_step_is_told_from_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with held(tmp_path / ".watch"):
        assert main(["evaluate", str(tmp_path)]) == 2
        told = capsys.readouterr().err
        assert "still being prepared" in told and "wait for the first one" in told
        check_run_or_training(tmp_path)  # the viewer waits
    # Left behind by one that was killed.
    assert (tmp_path / ".watch").exists()
    with pytest.raises(DataError, match="not a run folder"):
        check_run_or_training(tmp_path)


def test_what_inspect_takes_is_a_capture_a_recording_or_a_bag(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="capture.json: found no such file"):
        check_capture_or_recording(tmp_path)
    for name in ("capture.json", "metadata.yaml"):
        (tmp_path / name).touch()
        check_capture_or_recording(tmp_path)
        (tmp_path / name).unlink()
    for name in ("events.csv", "metadata.yaml"):
        (tmp_path / name).touch()
        check_capture_or_recording(tmp_path / name)
    (tmp_path / "capture.json").touch()
    with pytest.raises(DataError, match=f"Give the folder that it lies in: {tmp_path}\\."):
        check_capture_or_recording(tmp_path / "capture.json")


def test_a_video_is_no_capture_and_what_makes_it_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(DataError, match="found a file, expected a capture folder.*evsplat import"):
        check_capture_folder(tmp_path / "clip.mp4")
