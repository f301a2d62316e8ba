"""What the documentation takes from the program while it is built: the help of every command."""

import contextlib
import io
import os
from typing import Any

os.environ.update(COLUMNS="92", NO_COLOR="1", TERM="dumb")

_MARKER = "<!-- every command -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the commands where a page asks for them."""
    return markdown.replace(_MARKER, _commands()) if _MARKER in markdown else markdown


def _commands() -> str:
    from evsplat.cli.main import _VERBS

    parts = []
    for verb in _VERBS:
        parts.append(f"## evsplat {verb}\n\n```text\n{_help(verb)}\n```\n")
        if verb == "import":
            from evsplat.capture.importers import KINDS

            parts += [f"### evsplat import {k}\n\n```text\n{_help(verb, k)}\n```\n" for k in KINDS]
    return "\n".join(parts)


def _help(*words: str) -> str:
    from evsplat.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines())
