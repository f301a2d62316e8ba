"""Names and paths of other people's files stay in the folder that they are put into."""

import os
from pathlib import Path

import pytest

from evsplat.errors import DataError
from evsplat.names import checked_name, file_stem, is_name, is_path_of_names, leads_out

BAD_NAMES = {
    "empty": "",
    "the folder itself": ".",
    "the folder above": "..",
    "absolute": "/tmp/x",
    "upwards": "../../x",
    "below": "a/b",
    "backslash": "a\\b",
    "zero byte": "a\0b",
    "end of line": "a\nb",
    "escape": "\x1b[2J",
    "delete": "a\x7f",
    "second control block": "a\x85b",
    "line separator": "a\u2028b",
    "half a character": "a\ud800",
    "long": "x" * 201,
    "long in bytes": "ä" * 101,
}


@pytest.mark.parametrize("kind", BAD_NAMES)
def test_a_text_that_could_leave_its_folder_is_no_name(kind: str) -> None:
    assert not is_name(BAD_NAMES[kind])
    with pytest.raises(DataError, match="is no name for a frame, expected 1 to 200 bytes") as error:
        checked_name(BAD_NAMES[kind], "a frame")
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("name", ["0000", "Käfer 3", "...", ".x", "-x", "a:b", "ä" * 100, "😀"])
def test_names_that_file_systems_take_are_names(tmp_path: Path, name: str) -> None:
    assert checked_name(name, "a frame") == name
    (tmp_path / f"{name}.png").touch()
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.png"]


def test_paths_are_relative_and_made_of_names() -> None:
    for path in ("a.png", "images/a.png", "./images//a.png", "novel/side/a.png"):
        assert is_path_of_names(path)
    for path in ("", ".", "..", "/a", "a/../b", "../a", "a\\b", "a\0", "a/" + "x" * 201):
        assert not is_path_of_names(path)


def test_links_lead_out_where_their_end_is_elsewhere(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    (folder / "sub").mkdir(parents=True)
    for path in (tmp_path / "secret", tmp_path / "in2", folder / "a"):
        path.touch()
    links = {
        "to_a": "a",
        "round": "../in/a",
        "out": "../secret",
        "beside": "../in2",
        "up": "..",
        "itself": "itself",
    }
    for name, target in links.items():
        os.symlink(target, folder / name)
    (tmp_path / "other").symlink_to("in")
    for root in (folder, tmp_path / "other"):
        for inside in ("a", "sub/new", "to_a", "round", "itself", "up/in/a"):
            assert not leads_out(root / inside, root), inside
        for outside in ("out", "beside", "up", "up/secret", "."):
            assert leads_out(root / outside, root), outside


def test_names_of_frames_cannot_leave_the_folder_or_collide():
    assert file_stem("test", "0007") == "test_0007"
    stems = {file_stem("test", name) for name in ("../a/b", "../a b", "../a-b")}
    assert len(stems) == 3 and not any("/" in stem or " " in stem for stem in stems)
