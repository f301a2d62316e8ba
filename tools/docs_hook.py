"""What the documentation takes from the repository as it is built: commands, settings, files."""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

os.environ.update(COLUMNS="92", NO_COLOR="1", TERM="dumb")

_ROOT = Path(__file__).parents[1]
_COMMANDS = "<!-- every command -->"
_SETTINGS = re.compile(r"<!-- settings of (\S+) -->")
_FILE = re.compile(r"<!-- file (\S+) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the commands, settings and files where a page asks for them."""
    if _COMMANDS in markdown:
        markdown = markdown.replace(_COMMANDS, _commands())
    markdown = _SETTINGS.sub(lambda found: _settings(found.group(1)), markdown)
    return _FILE.sub(lambda found: _code(_ROOT / found.group(1)), markdown)


def _code(path: Path) -> str:
    return f"```python\n{path.read_text(encoding='utf-8').rstrip()}\n```"


def _settings(method: str) -> str:
    """A table for each section of a method's configuration."""
    from evsplat.config_docs import explained
    from evsplat.methods import TRAINABLE

    head = "\n| setting | default | takes | meaning |\n|---|---|---|---|"
    tables: dict[str, list[str]] = {"": [head]}
    for item in explained(TRAINABLE[method].config()):
        doc = item.doc.replace("``", "`").replace("|", "\\|")
        if item.is_section:
            tables[item.name] = [f"\n### {method}: {item.name}\n\n{doc}", head]
            continue
        doc += f" Read only if {item.read_if}." if item.read_if else ""
        row = f"| `{item.name}` | `{item.default}` | {item.takes} | {doc} |"
        tables[item.name.rpartition(".")[0]].append(row)
    return "\n".join("\n".join(rows) for rows in tables.values() if len(rows) > 1)


def _commands() -> str:
    from evsplat.cli.main import _VERBS

    parts = []
    for verb in _VERBS:
        parts.append(f"## evsplat {verb}\n\n```text\n{_help(verb)}\n```\n")
        if verb == "import":
            from evsplat.importers import KINDS

            parts += [f"### evsplat import {k}\n\n```text\n{_help(verb, k)}\n```\n" for k in KINDS]
    return "\n".join(parts)


def _help(*words: str) -> str:
    from evsplat.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines())
