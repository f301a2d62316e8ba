"""What the documentation takes from the repository as it is built: every command, examples."""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

os.environ.update(COLUMNS="92", NO_COLOR="1", TERM="dumb")

_ROOT = Path(__file__).parents[1]
_COMMANDS = "<!-- every command -->"
_FILE = re.compile(r"<!-- file (\S+) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the commands and files where a page asks for them."""
    if _COMMANDS in markdown:
        markdown = markdown.replace(_COMMANDS, _commands())
    return _FILE.sub(lambda found: _code(_ROOT / found.group(1)), markdown)


def _code(path: Path) -> str:
    return f"```python\n{path.read_text(encoding='utf-8').rstrip()}\n```"


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
