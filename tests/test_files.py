"""Files are written whole or not at all, to where links lead; what cannot be read says why."""

import os
import threading
from pathlib import Path

import pytest

from evsplat.errors import ConfigError, DataError
from evsplat.files import atomic_path, read_json, read_text, set_aside, write_json, write_text


def refused(path: Path) -> str:
    with pytest.raises(DataError) as error:
        read_json(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


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


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"a": ', "not valid JSON (Expecting value: line 1"),
        (b"[" * 5_000, "not valid JSON (nested too deeply); repair it"),
        (b'{"a":' * 5_000, "not valid JSON (nested too deeply)"),
        (b"1" * 5_000, "value has 5000 digits); repair it or write it anew."),
        (b"\xff\xfe", "not a text in UTF-8"),
    ],
)
def test_broken_json_is_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    assert said in refused(tmp_path / "a.json")


def test_what_is_no_file_is_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    assert refused(tmp_path / "no.json").endswith("no.json: file not found.")
    assert refused(tmp_path / "a.json" / "b").endswith("b: file not found.")
    assert refused(tmp_path).endswith("a folder, expected a file; correct the path.")
    assert "File name too long" in refused(tmp_path / ("x" * 300))


def test_a_file_that_may_not_be_read_is_not_called_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: object, **__: object) -> str:
        # as the system does, which lets root read everything
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", denied)
    assert refused(tmp_path / "a.json").endswith(
        "a.json: may not be read; give yourself the permission to read it."
    )
    with pytest.raises(ConfigError, match="a.yaml: may not be read"):
        read_text(tmp_path / "a.yaml", error=ConfigError)


def test_a_folder_set_aside_comes_back_unless_the_block_ends_well(tmp_path):
    folder = tmp_path / "folder"
    with set_aside(folder):
        assert not folder.exists()
    folder.mkdir()
    (folder / "old").touch()
    with pytest.raises(KeyboardInterrupt), set_aside(folder):
        assert not folder.exists()
        raise KeyboardInterrupt
    assert (folder / "old").exists()
    with set_aside(folder):
        folder.mkdir()
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
    assert not (folder / "old").exists()
