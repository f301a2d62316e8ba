"""Files are written whole or not at all, to where links lead."""

import os
import threading
from pathlib import Path

import pytest

from evsplat.errors import DataError
from evsplat.files import atomic_path, write_json, write_text


def test_an_interrupted_writer_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt"
        raise KeyboardInterrupt
    assert (tmp_path / "a.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


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
    with pytest.raises(KeyboardInterrupt), atomic_path(pipe):
        raise KeyboardInterrupt
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
