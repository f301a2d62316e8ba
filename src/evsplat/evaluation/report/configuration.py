"""The configuration of a run and what it ran with, flattened into short lists."""

from html import escape
from typing import Any

from evsplat.evaluation.report.html import section
from evsplat.evaluation.report.source import Source


def configuration(source: Source) -> str:
    """Every setting of the run, one block per component, and what it ran with."""
    loose = {key: value for key, value in source.config.items() if not isinstance(value, dict)}
    groups = {key: value for key, value in source.config.items() if isinstance(value, dict)}
    # Where the capture lay on the disk is nobody's business but the author's.
    facts = {key: value for key, value in source.versions.items() if key != "capture"}
    facts |= facts.pop("packages", {})
    named = [("run", loose), *groups.items(), ("made with", facts)]
    blocks = "".join(_block(str(name), values) for name, values in named)
    return section("Configuration", "", f'<div class="config">{blocks}</div>') if blocks else ""


def _block(name: str, values: dict[str, Any]) -> str:
    rows = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape(_plain(value))}</dd></div>"
        for key, value in _flat(values)
    )
    return f'<div class="group"><h3>{escape(name)}</h3><dl>{rows}</dl></div>' if rows else ""


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested settings as dotted keys."""
    result: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            result += _flat(value, f"{prefix}{key}.")
        else:
            result.append((f"{prefix}{key}", value))
    return result


def _plain(value: Any) -> str:
    """A setting as a reader would write it."""
    if value is None or value == []:
        return "–"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ", ".join(f"({_plain(v)})" if isinstance(v, list) else _plain(v) for v in value)
    return str(value)
