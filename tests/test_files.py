"""Files are written whole or not at all, to where links lead."""

import ctypes
import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from evsplat import disk
from evsplat.disk import held, is_held
from evsplat.errors import ConfigError, DataError, OutputError
from evsplat.files import (
    atomic_path,
    held_folder,
    new_folder,
    remove_folder,
    try_target,
    write_json,
    write_text,
)

from .limits import files_of_at_most


def test_an_interrupted_writer_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt"
        raise KeyboardInterrupt
    assert (tmp_path / "a.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_bytes_of_a_name_that_are_no_utf8_can_be_told_in_a_text(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", f"é {os.fsdecode(bytes([255]))}")
    assert (tmp_path / "a.txt").read_text() == "é \\udcff"


def test_a_pipe_is_written_into_and_stays(tmp_path: Path) -> None:
    """As /dev/stdout and /dev/null must."""
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()), daemon=True)
    reader.start()
    write_json(pipe, [1])
    reader.join(10)
    assert got == ["[\n 1\n]\n"] and pipe.is_fifo()
    reader = threading.Thread(target=pipe.read_text, daemon=True)
    reader.start()
    with pytest.raises(KeyboardInterrupt), atomic_path(pipe):
        raise KeyboardInterrupt
    reader.join(10)
    assert not reader.is_alive()
    # Nobody reads: a sentence in place of waiting for ever.
    with pytest.raises(OutputError, match="is a pipe that nobody reads"):
        write_json(pipe, [1])
    assert [path.name for path in tmp_path.iterdir()] == ["pipe.json"] and pipe.is_fifo()


@pytest.mark.parametrize("exists", [True, False])
def test_the_file_that_a_link_leads_to_is_replaced_and_the_link_stays(
    tmp_path: Path, exists: bool
) -> None:
    (tmp_path / "disk").mkdir()
    target, link, second = tmp_path / "disk" / "there", tmp_path / "link.txt", tmp_path / "second"
    if exists:
        target.write_text("old")
    link.symlink_to("disk/there")
    second.symlink_to("link.txt")
    with atomic_path(second) as temporary:
        # beside the file, so that its name can be taken in one step
        assert temporary.parent == target.parent
        temporary.write_text("new")
    assert target.read_text() == "new" and os.readlink(link) == "disk/there"
    assert second.is_symlink() and len(list((tmp_path / "disk").iterdir())) == 1


def test_a_writer_refuses_a_folder_and_a_link_to_itself(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="folder: is a folder; give the name of a file"):
        write_text(tmp_path / "folder", "x")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(DataError, match="loop: is a link that leads to itself; remove it"):
        write_text(tmp_path / "loop", "x")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "loop"]


LEAVES_A_HALF = """
import os, signal, sys
from pathlib import Path
from evsplat.files import atomic_path, new_folder
with new_folder(Path(sys.argv[1]) / "folder") as folder:
    (folder / "a").write_text("half")
    with atomic_path(Path(sys.argv[1]) / "file.txt") as temporary:
        temporary.write_text("half")
        if sys.argv[2] == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        print("written", flush=True)
        sys.stdin.read()
"""


def writing(folder: Path, end: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", LEAVES_A_HALF, str(folder), end]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_what_killed_writers_left_is_swept_and_what_living_ones_write_stays(tmp_path: Path) -> None:
    (tmp_path / ".evsplat-mine").touch()  # no name of ours
    assert writing(tmp_path, "die").wait(60) == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 3
    living = writing(tmp_path, "wait")
    assert living.stdout is not None and living.stdout.readline() == "written\n"
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) == 3, "the living one swept what the dead one left"
    disk._swept.clear()
    write_text(tmp_path / "other.txt", "new")
    assert {path.name for path in tmp_path.iterdir()} == left | {"other.txt"}
    living.communicate("")
    assert living.returncode == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        ".evsplat-mine",
        "other.txt",
        "file.txt",
        "folder",
    }


INTERRUPTED_TWICE = """
import os, signal, sys
from pathlib import Path
from evsplat.files import atomic_path
unlink = os.unlink
def interrupted(*arguments, **rest):
    raise KeyboardInterrupt
os.unlink = interrupted
try:
    with atomic_path(Path(sys.argv[1]) / "a"):
        raise ValueError
except KeyboardInterrupt:
    os.unlink = unlink
"""


def test_ctrl_c_in_the_midst_of_removing_leaves_nothing_at_the_end(tmp_path: Path) -> None:
    command = [sys.executable, "-c", INTERRUPTED_TWICE, str(tmp_path)]
    (tmp_path / ".evsplat-mine").touch()
    subprocess.run(command, check=True, timeout=60)
    assert [path.name for path in tmp_path.iterdir()] == [".evsplat-mine"]


def test_an_encoder_that_writes_beside_its_path_is_a_fault(tmp_path: Path) -> None:
    """Its file would neither be locked nor on the disk."""
    with pytest.raises(AssertionError), atomic_path(tmp_path / "a") as temporary:
        (tmp_path / "own").write_text("x")
        (tmp_path / "own").replace(temporary)
    assert list(tmp_path.iterdir()) == []


def test_a_link_named_like_a_left_over_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "a").touch()
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / ".evsplat-aaaaaaaa-aaaaaaaa.part").symlink_to(tmp_path / "precious")
    write_text(tmp_path / "in" / "x", "")
    assert (tmp_path / "precious" / "a").exists()


def test_what_takes_a_name_is_on_the_disk_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    flush, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("fsync"), flush(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("replace"), replace(a, b)))
    write_text(tmp_path / "a", "x")
    assert done == ["fsync", "replace", "fsync"], "the file, its name, the folder"
    done.clear()
    with new_folder(tmp_path / "folder") as folder:
        (folder / "in").mkdir()
        (folder / "in" / "a").touch()
    assert done.count("fsync") == 4, "the file, both folders, the folder around"


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_folder_is_replaced_whole_and_a_link_to_it_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool
) -> None:
    if not exchanges:
        monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: object())
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "a").touch()
    (tmp_path / "link").symlink_to("old")
    with new_folder(tmp_path / "link", replace=True) as folder:
        (folder / "b").touch()
        assert (tmp_path / "link" / "a").exists()
    assert [path.name for path in (tmp_path / "old").iterdir()] == ["b"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "old"]


def test_a_folder_that_is_a_link_is_not_removed(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "link").symlink_to("precious")
    with pytest.raises(DataError, match="link: is a link to another folder, so it stays"):
        remove_folder(tmp_path / "link")
    remove_folder(tmp_path / "precious")
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


def test_folders_made_for_nothing_go_again(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "a" / "b" / "c.txt"):
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "d" / "e"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_made_where_a_link_leads_that_nothing_is_at_yet(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("far/away")
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "link" / "in" / "a.txt"):
        raise ZeroDivisionError
    with held_folder(tmp_path / "link", "sign", "holds it."):
        assert (tmp_path / "far" / "away" / "sign").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["link"]
    write_text(tmp_path / "link" / "in" / "a.txt", "whole")
    assert (tmp_path / "far" / "away" / "in" / "a.txt").read_text() == "whole"


@pytest.mark.parametrize(
    ("number", "said", "no_room"),
    [
        (errno.ENOSPC, "not written, the disk is full; make room there", True),
        (errno.EDQUOT, "not written, the disk is full", True),
        (errno.EFBIG, "not written, files may not grow so large here", True),
        (errno.EROFS, "lies on a disk that is read-only; write elsewhere", False),
    ],
)
def test_a_write_that_fails_is_one_sentence(
    tmp_path: Path, number: int, said: str, no_room: bool
) -> None:
    with pytest.raises(OutputError) as error, atomic_path(tmp_path / "a.bin"):
        raise OSError(number, os.strerror(number))
    assert str(error.value).startswith(f"{tmp_path / 'a.bin'}: {said}")
    assert error.value.no_room == no_room and list(tmp_path.iterdir()) == []


def test_a_file_of_a_new_folder_that_fails_is_named_by_where_it_was_to_be(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError) as error,
        new_folder(tmp_path / "new") as folder,
        atomic_path(folder / "a.bin"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(error.value).startswith(f"{tmp_path / 'new' / 'a.bin'}: not written, the disk is")
    assert error.value.no_room and list(tmp_path.iterdir()) == []


def test_a_read_that_fails_while_something_is_written_is_not_the_output_s_fault(
    tmp_path: Path,
) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a"):
        (tmp_path / "source").read_text()


def test_a_target_is_tried_and_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    for target in ("file", "new/deep/file", "."):
        try_target(tmp_path / target)
    try_target("/dev/null")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "old"
    with pytest.raises(OutputError, match="a file is where a folder is needed"):
        try_target(tmp_path / "file" / "in")
    with pytest.raises(OutputError, match="the name is too long"):
        try_target(tmp_path / ("x" * 300))
    with pytest.raises(OutputError, match="MB are free on its disk, expected 1000000000000.0 MB"):
        try_target(tmp_path / "run", 10**18)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EACCES, "may not be written; give yourself"),
        (errno.EROFS, "a disk that is read-only"),
    ],
)
def test_a_target_without_permission_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    def denied(*_: object) -> None:
        # as the system does, which lets root write everywhere
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("tempfile.mkstemp", denied)
    with pytest.raises(OutputError, match=said):
        try_target(tmp_path / "out")


def test_a_lock_is_held_once_and_ends_with_its_holder(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    assert not is_held(sign)
    with held(sign):
        assert is_held(sign) and sign.read_text() == str(os.getpid())
        with pytest.raises(BlockingIOError) as error, held(sign):
            pass
        assert error.value.strerror == str(os.getpid())
    assert sign.exists() and not is_held(sign)


def test_a_lock_is_held_on_a_full_disk_and_leaves_nothing(tmp_path: Path) -> None:
    """There is room for a name, but none for the number of the process."""
    with files_of_at_most(0), held_folder(tmp_path, "sign", "holds it."):
        assert is_held(tmp_path / "sign") and (tmp_path / "sign").read_bytes() == b""
        with (
            pytest.raises(ConfigError, match="another process holds it"),
            held_folder(tmp_path, "sign", "holds it."),
        ):
            pass
    assert not list(tmp_path.iterdir())
