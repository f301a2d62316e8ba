"""Text in UTF-8, JSON and YAML."""

import json
from pathlib import Path
from typing import Any

import yaml

from evsplat.errors import DataError, EvsplatError
from evsplat.untrusted.faults import brief, ordinary_file, reason, why_not_read

_MOST_BYTES = 1 << 28
"""Of a text; a capture of 100,000 frames describes itself in 40 MB."""
_DEEPEST = 50
"""Levels of a YAML text; settings have a handful."""
_MOST_NODES = 100_000
"""Of a YAML text, those that an alias repeats counted again."""
_MISFITS = (TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What PyYAML raises, besides `ValueError` and its own errors, on tags such as ``!!bool 3``."""


def read_text(path: Path | str, *, error: type[EvsplatError] = DataError) -> str:
    """Read a UTF-8 text, less the mark that Windows begins one with; else an ``error``."""
    path = Path(path)
    size = ordinary_file(path, error=error)
    if size > _MOST_BYTES:
        raise error(f"{path}: {size:,} bytes are too many for a text, expected {_MOST_BYTES:,}.")
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as fault:
        raise error(f"{path}: {why_not_read(fault)}.") from None
    except UnicodeDecodeError as fault:
        raise error(f"{path}: not a text in UTF-8 ({fault}); write it anew.") from None


def read_json(path: Path | str) -> Any:
    """Read JSON; a missing or broken file is a `DataError` that names it."""
    path = Path(path)
    try:
        return parse_json(read_text(path))
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON ({error}); repair it or write it anew.") from None


def parse_json(text: str) -> Any:
    """The value that a JSON text stands for; all that can be wrong with it is a `ValueError`."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except ValueError as error:
        raise ValueError(reason(error)) from None


def parse_yaml(text: str) -> Any:
    """The value that a YAML text stands for; all that can be wrong with it is a `ValueError`."""
    try:
        return yaml.load(text, Loader=_Guarded)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except ValueError as error:
        raise ValueError(reason(error)) from None
    except _MISFITS:
        raise ValueError("a tag that its value does not fit") from None


class _Guarded(yaml.SafeLoader):
    """Values and nothing run; of a key that is there twice neither is taken silently.

    What is nested too deeply, or grows without end through aliases, is refused on the way: nodes
    come one by one, so that a text of brackets costs no more than its first few.
    """

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._nodes = self._deep = 0
        self._sizes: dict[str, int | None] = {}
        """Of the collections with an anchor; None while one is open."""

    def compose_node(self, parent: Any, index: Any) -> yaml.Node | None:
        event, start = self.peek_event(), self._nodes
        self._nodes += 1
        if isinstance(event, yaml.AliasEvent):
            size = self._sizes.get(event.anchor or "", 0)
            if size is None:
                raise ValueError(f"*{event.anchor} is a part of itself")
            self._nodes += size
        if self._nodes > _MOST_NODES:
            raise ValueError(f"more than {_MOST_NODES} values")
        if not isinstance(event, yaml.CollectionStartEvent):
            return super().compose_node(parent, index)
        if self._deep == _DEEPEST:
            raise ValueError(f"nested more than {_DEEPEST} deep")
        if event.anchor:
            self._sizes[event.anchor] = None
        self._deep += 1
        node = super().compose_node(parent, index)
        self._deep -= 1
        if event.anchor:
            self._sizes[event.anchor] = self._nodes - start
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        found = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.value == "<<":
                continue
            if key.value in found:
                line = key.start_mark.line + 1
                raise yaml.YAMLError(f"line {line}: the key {brief(key.value)} for the second time")
            found.add(key.value)
        return node
