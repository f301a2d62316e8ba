"""The versions that pyproject.toml asks for are those that were tried."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
_UNBOUNDED = {"stlpips-pytorch", "ninja", "evsplat"}
"""Without a bound of their own."""
_NOT_FOR_USERS = ("dev", "docs")


def _asked() -> dict[str, Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [line for name in extras if name not in _NOT_FOR_USERS for line in extras[name]]
    asked = [Requirement(line) for line in (*project["dependencies"], *lines)]
    return {each.name: each for each in asked if each.name not in _UNBOUNDED}


def _pinned(name: str) -> dict[str, Version]:
    pins = re.findall(r"^([\w-]+)==(\S+)$", (ROOT / name).read_text(), re.MULTILINE)
    return {package.lower(): Version(version) for package, version in pins}


def test_the_lowest_versions_are_those_that_the_suite_has_passed_with():
    asked, tried = _asked(), _pinned("constraints-lowest.txt")
    assert set(tried) == set(asked)
    for name, requirement in asked.items():
        (lowest,) = [each.version for each in requirement.specifier if each.operator == ">="]
        assert requirement.specifier.contains(tried[name])
        # 10.3 is 10.3.0; of OpenCV the last number counts builds.
        assert tried[name].release[: len(Version(lowest).release)] == Version(lowest).release
        assert not any(tried[name].release[len(Version(lowest).release) : 3])


@pytest.mark.parametrize("name", ["constraints.txt", "constraints-lowest.txt"])
def test_what_is_pinned_suits_what_is_asked(name):
    pinned = _pinned(name)
    for package, requirement in _asked().items():
        assert requirement.specifier.contains(pinned[package]), package
