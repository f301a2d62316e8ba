"""No message of an import names an option that its command does not have."""

import ast
import re
from collections.abc import Iterator

import pytest

from evsplat.cli.main import main
from evsplat.importers import KINDS

from ..source import modules

_OPTION = re.compile(r"--[a-z][a-z_-]+")
_OTHER_VERB = re.compile(r"(--[a-z-]+ of )?'evsplat [^']*'")
_OF_ANOTHER = {"--output_type"}
"""Of COLMAP, quoted with its command."""


def options(kind: str, capsys) -> set[str]:
    """What ``evsplat import KIND --help`` lists."""
    with pytest.raises(SystemExit):
        main(["import", kind, "--help"])
    return set(_OPTION.findall(capsys.readouterr().out))


def named(kind: str) -> set[str]:
    """Options in the words of an importer, and of what it calls in other modules of importers."""
    home = KINDS[kind].__module__
    found: set[str] = set()
    waiting, seen = [(home, name) for name in definitions(home)], set()
    while waiting:
        place = waiting.pop()
        if place in seen:
            continue
        seen.add(place)
        module, name = place
        node = definitions(module)[name]
        for words in texts(node):
            found |= set(_OPTION.findall(_OTHER_VERB.sub("", words)))
        for child in ast.walk(node):
            if isinstance(child, ast.Call) and getattr(child.func, "id", "") == "check_positive":
                found |= {f"--{word.arg}".replace("_", "-") for word in child.keywords}
            if isinstance(child, ast.Call) and getattr(child.func, "id", "") == "open_recording":
                found.add("--repair")  # which messages of all formats name
            if isinstance(child, ast.Name):
                waiting += reached(module, child.id)
    return found


def definitions(module: str) -> dict[str, ast.AST]:
    """Functions and classes of a module."""
    body = tree(module).body
    return {n.name: n for n in body if isinstance(n, (ast.FunctionDef, ast.ClassDef))}


def reached(module: str, name: str) -> Iterator[tuple[str, str]]:
    """Where a name of a module is defined, if among importers."""
    if name in definitions(module):
        yield module, name
    for node in tree(module).body:
        source = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
        if isinstance(node, ast.ImportFrom) and source.startswith("evsplat.importers."):
            if name in {alias.name for alias in node.names} and name in definitions(source):
                yield source, name


def tree(module: str) -> ast.Module:
    return modules()[f"{module.removeprefix('evsplat.').replace('.', '/')}.py"]


def texts(node: ast.AST) -> Iterator[str]:
    """Strings, joined as a reader sees them, that are not docstrings."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.JoinedStr):
        yield "".join(str(part.value) for part in node.values if isinstance(part, ast.Constant))
        return
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "command":
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    for child in ast.iter_child_nodes(node):
        yield from texts(child)


@pytest.mark.parametrize("kind", KINDS)
def test_what_messages_name_is_there(kind: str, capsys) -> None:
    words = named(kind)
    assert words, "what is compared is found at all"
    assert words - _OF_ANOTHER <= options(kind, capsys)


def test_the_words_of_an_importer_are_those_of_all_that_it_calls() -> None:
    """The comparison sees what a function two modules away says of an option."""
    assert {"--clock-offset-us", "--focal", "--camera", "--shrink"} <= named("davis")
    assert "--focal" not in named("zju-mocap") and "--frames" in named("neuman")


def test_every_importer_of_a_recording_has_the_options_of_the_others(capsys) -> None:
    told = {kind: options(kind, capsys) for kind in ("folder", "video", "davis")}
    shared = told["folder"] & told["video"]
    of_separate_files = {"--events", "--exposure-us", "--fps", "--homography", "--start-us"}
    assert shared - told["davis"] == of_separate_files
    for kind in KINDS:
        assert {"--frames", "--shrink", "--no-poses"} <= options(kind, capsys), kind
