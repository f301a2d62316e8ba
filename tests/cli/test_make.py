"""Set-up through the Makefile: what it runs, what it reuses, what it refuses in one sentence."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.skipif(not (ROOT / "Makefile").exists(), reason="not a source checkout"),
    pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed"),
]


def _plan(target, venv):
    """Commands that make would run, without running them."""
    done = subprocess.run(
        ["make", "-n", target, f"VENV={venv}"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_was_compiled_as_it_was_imported_is_kept():
    """pip compiles nothing (`PIP_COMPILE`), so each start would compile PyTorch again."""
    shown = "shown: ; @echo kept$$PYTHONDONTWRITEBYTECODE"
    done = subprocess.run(
        ["make", "-s", f"--eval={shown}", "shown"],
        cwd=ROOT,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "kept\n"


def _make_venv(target, **environment):
    done = subprocess.run(
        ["sh", str(ROOT / "tools" / "make_venv.sh"), str(target)],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )
    return done.returncode, done.stderr


def _touch(venv, *stamps):
    """Stamps made one after the other, each by itself newer than the one before."""
    venv.mkdir(exist_ok=True)
    for seconds, stamp in enumerate(stamps, start=int(time.time())):
        (venv / stamp).touch()
        os.utime(venv / stamp, (seconds, seconds))


@pytest.mark.parametrize(
    ("target", "command", "extra"),
    [
        ("demo", "evsplat demo", None),
        ("view", "evsplat view", "view"),
        ("test", "-m pytest", "dev"),
        ("lint", "ruff check", "dev"),
        ("types", "mypy", "dev"),
        ("docs", "mkdocs build", "dev"),
        ("fuzz", "fuzz.py", "dev"),
        ("kill", "kill.py", "dev"),
    ],
)
def test_a_target_installs_what_it_needs_and_a_second_call_reuses(tmp_path, target, command, extra):
    first = _plan(target, tmp_path / "venv")
    assert "make_venv.sh" in first
    installs = [line for line in first.splitlines() if "pip install" in line]
    assert all("--constraint constraints.txt" in line for line in installs)
    assert sum("--no-deps --editable ." in line for line in installs) == 1
    assert sum("--requirement" in line for line in installs) == 1
    assert not any("evsplat[" in line for line in installs[:2])
    assert re.findall(r"evsplat\[(\w+)\]", first) == ([extra] if extra else [])
    assert command in first
    stamps = [".installed", f".installed-{extra}"] if extra else [".installed"]
    _touch(tmp_path / "venv", *stamps)
    second = _plan(target, tmp_path / "venv")
    assert "pip install" not in second
    assert command in second


_PIP = """#!{python}
import pathlib, subprocess, sys, time

given, here = sys.argv[1:], pathlib.Path({folder!r})
if given[:2] != ["-m", "pip"]:
    sys.exit(subprocess.call([{python!r}, *given]))
kind = "package" if "--editable" in given else "dependencies"
(here / kind).write_text(
    " ".join(given) if kind == "package" else pathlib.Path(given[-1]).read_text()
)
for _ in range(600):  # either is over only once the other has begun
    if len(list(here.glob("[dp]*"))) == 2:
        break
    time.sleep(0.1)
else:
    sys.exit("alone")
if {pause}:
    (here / "waits").with_suffix("." + kind).touch()
    time.sleep(60)
if kind == {failing!r}:
    print("out of " + kind, file=sys.stderr)
    sys.exit(1)
if kind == "dependencies":
    time.sleep(0.5)
    print("unpacked")
"""
"""Stands for the environment's Python: pip that only says what it was asked for."""


def _set_up(tmp_path, failing="", pause=False):
    """Begin to make a new environment, in which a pip that does nothing stands for pip."""
    made, seen = tmp_path / "venv", tmp_path / "seen"
    for folder in (made / "bin", seen):
        folder.mkdir(parents=True)
    python = made / "bin" / "python"
    python.write_text(
        _PIP.format(python=sys.executable, folder=str(seen), failing=failing, pause=pause)
    )
    python.chmod(0o755)
    # Whoever is started in the background ignores Ctrl-C, and would pass that on.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    running = subprocess.Popen(
        ["make", f"VENV={made}", str(made / ".installed")],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    signal.signal(signal.SIGINT, before)
    return running, made, seen


def test_packages_are_installed_while_the_module_is_compiled(tmp_path):
    running, made, seen = _set_up(tmp_path)
    said, _ = running.communicate(timeout=120)
    assert running.returncode == 0, said
    assert (made / ".installed").exists()
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert (seen / "dependencies").read_text().split("\n") == [*declared, ""]
    assert "--no-deps" in (seen / "package").read_text()


@pytest.mark.parametrize("failing", ["package", "dependencies"])
def test_either_failure_is_told_last_and_leaves_nothing_that_looks_set_up(tmp_path, failing):
    running, made, _ = _set_up(tmp_path, failing)
    said, _ = running.communicate(timeout=120)
    assert running.returncode != 0
    assert f"out of {failing}" in said
    if failing == "package":
        assert said.index("unpacked") < said.index("out of package")
    assert not (made / ".installed").exists()


def test_ctrl_c_ends_both_halves_of_the_installation(tmp_path):
    running, made, seen = _set_up(tmp_path, pause=True)
    end = time.monotonic() + 60
    while len(list(seen.glob("waits.*"))) < 2:
        assert time.monotonic() < end and running.poll() is None
        time.sleep(0.1)
    os.killpg(running.pid, signal.SIGINT)
    said, _ = running.communicate(timeout=20)  # the pipe closes once all of them are gone
    assert running.returncode != 0
    assert not (made / ".installed").exists()


def test_after_the_demo_the_tests_build_nothing_again(tmp_path):
    _touch(tmp_path, ".installed")
    plan = _plan("test", tmp_path)
    assert "--editable" not in plan
    assert '"evsplat[dev]"' in plan


@pytest.mark.parametrize(
    "name", ["pyproject.toml", "constraints.txt", "CMakeLists.txt", "native/module.cpp"]
)
def test_a_newer_input_sets_up_again(tmp_path, name):
    before = int((ROOT / name).stat().st_mtime) - 10
    for stamp in (".installed", ".installed-dev"):
        (tmp_path / stamp).touch()
        os.utime(tmp_path / stamp, (before, before))
    plan = _plan("test", tmp_path)
    assert "--editable" in plan
    assert '"evsplat[dev]"' in plan


def test_wrong_python_and_missing_tools_are_one_sentence(tmp_path):
    old = tmp_path / "python-too-old"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    code, message = _make_venv(tmp_path / "venv", PYTHON=str(old))
    assert code != 0
    assert "3.11" in message and message.count("\n") == 1

    bare = tmp_path / "python-without-venv"
    bare.write_text(
        f'#!/bin/sh\ncase "$*" in *ensurepip*) exit 1;; esac\nexec {sys.executable} "$@"\n'
    )
    bare.chmod(0o755)
    code, message = _make_venv(tmp_path / "venv", PYTHON=str(bare))
    assert code != 0
    assert "python3-venv" in message and message.count("\n") == 1

    code, message = _make_venv(tmp_path / "venv", PYTHON=sys.executable, CXX="no-such-compiler")
    assert code != 0
    assert "no-such-compiler" in message and message.count("\n") == 1
    assert not (tmp_path / "venv").exists()


def test_a_folder_that_is_no_environment_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    code, message = _make_venv(tmp_path, PYTHON=sys.executable)
    assert code != 0
    assert "VENV=" in message
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
