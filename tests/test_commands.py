"""Commands that the user is given can be typed as they stand, whatever the paths are called."""

import re
import shlex
import sys
from pathlib import Path

import pytest

from evsplat.commands import command

SOURCE = Path(__file__).parents[1] / "src"


@pytest.mark.parametrize("name", ["plain", "my capture", "Tänzerin ½", "it's", "a;b", "$HOME", "*"])
def test_a_shell_reads_the_words_that_were_meant(name: str) -> None:
    words = ["train", Path("in") / name, "--out", Path(name)]
    assert shlex.split(command(*words)) == ["evsplat", *map(str, words)]


def test_a_path_that_begins_with_a_dash_is_no_option() -> None:
    words = ["view", Path("./-run"), Path("--out"), "--port"]
    assert command(*words) == "evsplat view ./-run ./--out --port"


@pytest.mark.parametrize(
    ("called", "shown"),
    [
        ("my env/bin/evsplat", "'my env/bin/evsplat' view run"),
        ("/usr/bin/evsplat", "evsplat view run"),
        ("/x/site-packages/pytest/__main__.py", "evsplat view run"),
    ],
)
def test_the_program_is_named_as_it_was_called(monkeypatch, called: str, shown: str) -> None:
    monkeypatch.setattr(sys, "argv", [called, "anything"])
    assert command("view", "run") == shown


def test_no_message_puts_a_path_into_a_command_by_hand() -> None:
    by_hand = re.compile(r"evsplat (?:[a-z]+ )(?:[\w. -]*)(?:\{|%s)")
    found = [
        f"{path.name}: {line.strip()}"
        for path in SOURCE.rglob("*.py")
        for line in path.read_text("utf-8").splitlines()
        if by_hand.search(line)
    ]
    assert found == []
