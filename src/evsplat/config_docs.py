"""Settings explained: what each takes and means, from its annotation and its docstring."""

import dataclasses
import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import yaml

from evsplat.config import Setting, settings, to_dict
from evsplat.field_docs import field_docs
from evsplat.files import write_text
from evsplat.ranges import expected

_WIDTH = 100
"""Columns of a written configuration."""
_PLAIN = ("a number", "an integer", "true or false", "a text")
"""Types that a value shows already."""


@dataclass(frozen=True)
class Explained:
    """A setting or a section in words."""

    name: str
    """Dotted name from the root of the configuration."""
    is_section: bool
    takes: str
    """Type and range: "a number above 0 or null"."""
    value: Any
    """Value, ready for YAML; of a section nothing."""
    default: str
    """Default, as `flow` writes it; of a section nothing."""
    read_if: str
    """Conditions without which nothing reads it: "shadow_lights is above 0"; most have none."""
    doc: str
    """Docstring in one line; empty where the source is not at hand."""


def explained(config: Any) -> list[Explained]:
    """Every setting of a configuration in words; a section comes before what is in it."""
    # A list of sections is one setting.
    every = [setting for setting in settings(config) if "[" not in setting.name]
    docs = {owner: field_docs(owner) for owner in {setting.owner for setting in every}}
    return [_explained(setting, docs[setting.owner], every) for setting in every]


def _explained(setting: Setting, docs: Mapping[str, str], every: list[Setting]) -> Explained:
    is_section = dataclasses.is_dataclass(setting.value)
    doc = docs.get(setting.name.rpartition(".")[2], "")
    if is_section and not doc:
        doc = (type(setting.value).__doc__ or "").partition("\n")[0]
    takes = expected(setting.hint)
    if "with keys" in takes and not is_section:
        alike = [other.name for other in every if _names(setting.hint, type(other.value))]
        takes = takes.replace("with keys", f"with the keys of {alike[0]}") if alike else takes
    conditions = dict.fromkeys(f"{name} is {mark.condition}" for name, mark in setting.conditions)
    value = None if is_section else to_dict(setting.value)
    default = "" if is_section else flow(to_dict(setting.default))
    read_if = " and ".join(conditions)
    return Explained(setting.name, is_section, takes, value, default, read_if, doc)


def explained_yaml(config: Any, **first: Any) -> str:
    """A configuration as YAML with a comment above each setting; ``first`` are keys before it."""
    lines = [f"{name}: {flow(value)}" for name, value in first.items()]
    for item in explained(config):
        *sections, field = item.name.split(".")
        indent, value = "  " * len(sections), "" if item.is_section else f" {flow(item.value)}"
        facts = [] if item.is_section or item.takes in _PLAIN else [item.takes]
        facts += [] if value.strip() == item.default else [f"default {item.default}"]
        facts += [f"read if {item.read_if}"] if item.read_if else []
        told = f"{item.doc} ({'; '.join(facts)})" if facts else item.doc
        comment = f"{indent}# "
        lines += [] if sections else [""]
        lines += textwrap.wrap(
            told.replace("``", "").strip(),
            _WIDTH,
            initial_indent=comment,
            subsequent_indent=comment,
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines.append(f"{indent}{field}:{value}")
    return "\n".join(lines) + "\n"


def save_yaml(path: Path | str, config: Any, **first: Any) -> None:
    """Write `explained_yaml`; `evsplat.config.load_yaml` gives ``first`` and the values back."""
    write_text(path, explained_yaml(config, **first))


def flow(value: Any) -> str:
    """A value as YAML in one line."""
    text = yaml.safe_dump(value, default_flow_style=True, width=math.inf).removesuffix("...\n")
    if "\n" in text.strip():
        text = yaml.safe_dump(value, default_flow_style=True, width=math.inf, default_style='"')
    return str(text).strip()


def _names(hint: Any, section: type[Any]) -> bool:
    """Whether a type is a section or may be one."""
    is_section = hint is section and dataclasses.is_dataclass(section)
    return is_section or any(_names(part, section) for part in get_args(hint))
