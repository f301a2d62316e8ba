"""Texts, JSON and YAML that cannot be read say why, in one sentence."""

import os
from pathlib import Path

import pytest

from evsplat.errors import ConfigError, DataError
from evsplat.untrusted.arrays import read_table
from evsplat.untrusted.faults import open_text
from evsplat.untrusted.text import parse_yaml, read_json, read_text


def refused(path: Path) -> str:
    with pytest.raises(DataError) as error:
        read_json(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"a": ', "not valid JSON (Expecting value: line 1"),
        (b"[" * 100_000, "not valid JSON (nested too deeply); repair it"),
        (b'{"a":' * 100_000, "not valid JSON (nested too deeply)"),
        (b"1" * 5_000, "value has 5000 digits); repair it or write it anew."),
        (b"\xff\xfe", "not a text in UTF-8"),
    ],
)
def test_broken_json_is_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    assert said in refused(tmp_path / "a.json")


def test_the_mark_that_windows_begins_a_text_with_is_none_of_it(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}\r\n')
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf0 10\r\n20 30\r\n")
    assert read_json(tmp_path / "a.json") == {"a": 1}
    assert read_table(tmp_path / "a.txt").tolist() == [[0, 10], [20, 30]]
    with open_text(tmp_path / "a.txt") as lines:
        assert [line.split() for line in lines] == [["0", "10"], ["20", "30"]]


def test_what_is_no_file_is_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    assert refused(tmp_path / "no.json").endswith("no.json: file not found.")
    assert refused(tmp_path / "a.json" / "b").endswith("b: file not found.")
    assert refused(tmp_path).endswith("a folder, expected a file; correct the path.")
    assert "File name too long" in refused(tmp_path / ("x" * 300))


def test_a_file_that_may_not_be_read_is_not_called_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.json", "a.yaml"):
        (tmp_path / name).write_text("{}")
    # as the system says, which lets root read everything
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert refused(tmp_path / "a.json").endswith(
        "a.json: may not be read; give yourself the permission to read it."
    )
    with pytest.raises(ConfigError, match="a.yaml: may not be read"):
        read_text(tmp_path / "a.yaml", error=ConfigError)


def test_pipes_and_devices_are_no_files(tmp_path: Path) -> None:
    """A pipe that nobody writes into never ends, nor does /dev/zero."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name in ("pipe", "zeros"):
        assert "a device or pipe, expected a file" in refused(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "nested more than 50 deep"),
        ("a: &a [*a]", r"\*a is a part of itself"),
        ("2001-99-99", "month must be in 1..12"),
        ("9" * 5_000, "5000 digits"),
        ("!!bool 3", "a tag that its value does not fit"),
        ("a: 1\nb: {c: 1, d: 2, c: 3}", "line 2: the key 'c' for the second time"),
        # a billion of laughs
        (
            "a0: &a0 [ha]\n"
            + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)),
            "more than 100000 values",
        ),
    ],
)
def test_what_yaml_cannot_mean_is_a_value_error(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_yaml(text)


def test_aliases_and_merged_sections_are_read() -> None:
    text = "base: &base {a: 1, b: &b [2, 3]}\nother: {<<: *base, c: *b, a: 4}"
    assert parse_yaml(text)["other"] == {"a": 4, "b": [2, 3], "c": [2, 3]}


def test_a_sentence_that_quotes_half_a_character_can_be_written_anywhere(tmp_path):
    """JSON may hold half of a surrogate pair, and a file's name bytes that are no UTF-8."""
    file = tmp_path / "poses.json"
    file.write_text('{"\\ud800": 1}')
    (found,) = read_json(file)
    said = str(DataError(f"{file}: unknown key {found!s}"))
    assert said.encode().endswith(b"unknown key \\ud800")
