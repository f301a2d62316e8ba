"""Settings in words: every one explained, in config.yaml, on the terminal and in the docs."""

import inspect
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evsplat import field_docs
from evsplat.cli import main
from evsplat.config import from_dict, load_yaml
from evsplat.config_docs import explained, explained_yaml, save_yaml
from evsplat.methods import TRAINABLE
from evsplat.ranges import Above, AtLeast, ReadIf

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Lamps:
    """Lamps of the scene."""

    count: Annotated[int, AtLeast(0)] = 0
    """How many lamps, each at a
    place of its own."""
    width: Annotated[float, Above(0), ReadIf("count", "above 0", lambda n: n > 0)] = 0.1
    """Half width of their shadows, in ``metres``."""
    kind: Literal["point", "sun"] = "point"
    names: tuple[str, ...] = ()
    """Names of lamps, for the log: 'a: b' # and so on."""


@dataclass(frozen=True)
class MoreLamps(Lamps):
    """Lamps of the scene and others."""

    count: Annotated[int, AtLeast(0)] = 2
    kind: Literal["point", "sun"] = "sun"
    """How they shine."""


@dataclass(frozen=True)
class Config:
    """All of it."""

    lamps: Lamps = field(default_factory=lambda: Lamps(width=0.5))
    shade: bool = False
    """Shade what is behind."""
    others: Annotated[Lamps | None, ReadIf("shade", "true", bool)] = None
    """Lamps of others; null = as `lamps`."""
    more: MoreLamps = field(default_factory=MoreLamps)
    """Lamps to come."""
    weight: float | tuple[tuple[float, float], ...] = 0.1
    """Weight of the long-winded explanation that reaches over several lines of the file, since it
    holds far more words than one line of a hundred columns can hold, even without the indentation
    that sections in sections would need."""


def test_settings_are_explained_by_types_defaults_conditions_and_docstrings():
    words = {item.name: item for item in explained(Config(shade=True))}
    assert list(words)[:3] == ["lamps", "lamps.count", "lamps.width"]
    assert words["lamps"].is_section and words["lamps"].doc == "Lamps of the scene."
    assert words["lamps.count"].doc == "How many lamps, each at a place of its own."
    width = words["lamps.width"]
    assert (width.takes, width.default, width.read_if) == (
        "a number above 0",
        "0.5",
        "lamps.count is above 0",
    )
    assert words["lamps.kind"].doc == "" and words["lamps.kind"].takes == "one of point, sun"
    assert (words["shade"].value, words["shade"].default) == (True, "false")
    assert words["others"].takes == "a section with the keys of lamps or null"
    assert words["others"].read_if == "shade is true"
    # A docstring of the class that is nearest and has one.
    assert words["more.count"].doc == words["lamps.count"].doc
    assert words["more.kind"].doc == "How they shine."
    assert words["weight"].takes == "a number or a list of [a number, a number]"


def test_a_written_configuration_explains_itself():
    text = explained_yaml(Config(shade=True, weight=((0.0, 1e-5),)), method="lit")
    assert text.startswith(
        """method: lit

# Lamps of the scene.
lamps:
  # How many lamps, each at a place of its own. (an integer of at least 0)
  count: 0
  # Half width of their shadows, in metres. (a number above 0; read if lamps.count is above 0)
  width: 0.5
  # (one of point, sun)
  kind: point
"""
    )
    assert "# Shade what is behind. (default false)\nshade: true\n" in text
    facts = "(a number or a list of [a number, a number]; default 0.1)"
    assert f"would need. {facts}\nweight: [[0.0, 1.0e-05]]\n" in text
    assert max(map(len, text.splitlines())) <= 100


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))


@given(
    st.builds(
        Config,
        st.builds(Lamps, count=st.integers(1, 2**53), width=st.floats(1e-300, 1e300)),
        st.booleans(),
        more=st.builds(MoreLamps, names=st.lists(TEXTS).map(tuple)),
        weight=st.floats(allow_nan=False, allow_infinity=False),
    ),
    TEXTS,
)
def test_comments_change_nothing_of_what_is_read_back(tmp_path_factory, config, name):
    path = tmp_path_factory.mktemp("yaml") / "c.yaml"
    save_yaml(path, config, name=name)
    values = load_yaml(path)
    assert values.pop("name") == name
    assert from_dict(Config, values, where="c") == config


def test_a_configuration_is_written_where_there_is_no_source(tmp_path, monkeypatch):
    def gone(kind: Any) -> str:
        raise OSError("could not get source code")

    monkeypatch.setattr(inspect, "getsource", gone)
    monkeypatch.setattr(field_docs, "_READ", {})
    save_yaml(tmp_path / "c.yaml", Config())
    assert from_dict(Config, load_yaml(tmp_path / "c.yaml"), where="c") == Config()


@pytest.mark.parametrize("method", TRAINABLE)
def test_every_method_is_explained_and_loads_as_printed(method, tmp_path, capsys):
    assert main(["settings", "--method", method]) == 0
    text = capsys.readouterr().out
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    values = load_yaml(tmp_path / "c.yaml")
    kind = TRAINABLE[method].config
    assert values.pop("method") == method
    assert from_dict(kind, values, where="c") == kind()
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize("method", TRAINABLE)
def test_every_setting_of_every_method_has_a_docstring(method):
    config = TRAINABLE[method].config()
    assert [item.name for item in explained(config) if not item.doc] == []


def test_the_docs_list_the_settings_of_every_method():
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert sorted(re.findall("<!-- settings of (.+?) -->", page)) == sorted(TRAINABLE)
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from docs_hook import on_page_markdown
    finally:
        sys.path.pop(0)
    shown = on_page_markdown(page)
    for method in TRAINABLE:
        for item in explained(TRAINABLE[method].config()):
            assert item.is_section or f"| `{item.name}` | " in shown
            # Which keys is said by the name of a section that has them.
            assert item.is_section or "with keys" not in item.takes
