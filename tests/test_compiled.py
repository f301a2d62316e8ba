"""A compiled module that is older than its sources' calls; what it asks of the C library."""

import ctypes
import multiprocessing
import os
import platform
import re
import resource
from concurrent.futures import ProcessPoolExecutor
from operator import methodcaller
from pathlib import Path

import pytest
import torch
from tests.source import SOURCE

from evsplat import compiled
from evsplat.cli import main
from evsplat.cli.exits import exit_code
from evsplat.errors import BackendError
from evsplat.neighbours import far_apart

native = compiled.native


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch) -> Path:
    """A source of the compiled module, as old as is said of it."""
    (tmp_path / "native").mkdir()
    monkeypatch.setattr(compiled, "_CHECKOUT", tmp_path)
    return tmp_path


def aged(checkout: Path, seconds: float) -> None:
    """Write a source so much after the module was built."""
    source = checkout / "native" / "module.cpp"
    source.touch()
    built = Path(native.__file__).stat().st_mtime
    os.utime(source, (built + seconds, built + seconds))


def test_all_that_sources_call_is_in_the_module():
    called = {
        name
        for path in SOURCE.rglob("*.py")
        for name in re.findall(r"\bnative(?:_for\([^)]*\))?\.(\w+)\(", path.read_text("utf-8"))
    }
    assert len(called) > 30
    assert called <= set(dir(native))


def test_a_verb_names_the_older_module_and_how_to_build_it(
    tmp_path: Path, capsys, monkeypatch, checkout: Path
):
    events = tmp_path / "events.csv"
    events.write_text("t,x,y,p\n1,2,3,1\n2,2,3,0\n")
    monkeypatch.delattr(native, "parse_events")
    assert main(["convert", str(events), str(tmp_path / "out.h5")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"evsplat: {native.__file__}: evsplat's compiled module is older than ")
    assert "(it has no parse_events); build it anew: " in said and said.count("\n") == 1
    assert said.rstrip().endswith(f"-m pip install -e {checkout}")
    assert not (tmp_path / "out.h5").exists()


def test_from_python_it_is_the_same_sentence(monkeypatch):
    monkeypatch.delattr(native, "spread_points")
    with pytest.raises(BackendError, match="it has no spread_points"):
        far_apart(torch.rand(9, 3), 5)


def test_what_python_itself_asks_of_a_module_is_simply_not_there():
    assert not hasattr(native, "__wrapped__")
    assert not hasattr(native, "no_such_function")


def test_what_an_object_of_the_module_lacks_is_told(capsys, checkout: Path):
    kind = next(one for one in vars(native).values() if isinstance(one, type))

    assert exit_code(lambda: getattr(kind, "no_such_method")) == 2  # noqa: B009 - typed
    assert "no_such_method" in capsys.readouterr().err


def test_other_arguments_are_told_where_a_source_is_newer(capsys, checkout: Path):
    aged(checkout, 60)
    assert exit_code(lambda: native.window_means(1)) == 2
    said = capsys.readouterr().err
    assert "(window_means(): incompatible function arguments" in said and said.count("\n") == 1


@pytest.mark.parametrize("error", [TypeError, AttributeError])
def test_faults_of_the_sources_stay_what_they_are(checkout: Path, error):
    aged(checkout, -60)
    called = {TypeError: native.window_means, AttributeError: methodcaller("missing")}
    with pytest.raises(error):
        exit_code(lambda: called[error](1))


def _faults_of_steps(keeping: bool) -> int:
    """Pages that the system hands over in four steps of four arrays of 28 MB."""
    if keeping:
        compiled.keep_freed_memory()
        compiled.keep_freed_memory()  # asked for again, it does nothing
    # Without tensors, whose small parts may come to lie at the end of the heap and hold it there.
    library = ctypes.CDLL(None)
    library.malloc.restype, library.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    for _ in range(2):  # the second time, without what the first steps of all need
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(4):
            arrays = [library.malloc(28 << 20) for _ in range(4)]
            for array in arrays:
                ctypes.memset(array, 1, 28 << 20)
            for array in arrays:
                library.free(array)
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    return faults


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator is what is told")
def test_freed_memory_is_kept_for_the_next_step():
    context = multiprocessing.get_context("spawn")  # the setting holds for a whole process
    with ProcessPoolExecutor(1, context) as plain, ProcessPoolExecutor(1, context) as keeping:
        given_back = plain.submit(_faults_of_steps, False).result()
        kept = keeping.submit(_faults_of_steps, True).result()
    assert kept < given_back / 100, (kept, given_back)
