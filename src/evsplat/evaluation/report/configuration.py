"""The configuration of a run and what it ran with, flattened into short lists."""

from html import escape
from typing import Any

from evsplat.config import to_dict
from evsplat.evaluation.report.source import Source
from evsplat.methods import TRAINABLE, method_config
from evsplat.pages import folded, section

_HARDWARE = ("device", "gpu", "cpu", "cpu_cores", "threads", "memory_gb", "machine")


def configuration(source: Source) -> str:
    """The settings that differ from the method's defaults, and behind a click all of the run."""
    if not source.config:
        return ""
    loose = {key: value for key, value in source.config.items() if not isinstance(value, dict)}
    groups = {key: value for key, value in source.config.items() if isinstance(value, dict)}
    everything = "".join(_block(str(name), v) for name, v in [("run", loose), *groups.items()])
    changed = _changed(source.config)
    if changed is None:
        shown = '<p class="note">The defaults of this method are not known here.</p>'
    elif changed:
        rows = "".join(
            f'<tr><th scope="row">{escape(key)}</th><td>{escape(_plain(value))}</td>'
            f"<td>{escape(_plain(default))}</td></tr>"
            for key, value, default in changed
        )
        shown = (
            '<div class="scroll plain"><table><thead><tr><th scope="col" class="corner">setting'
            '</th><th scope="col">this run</th><th scope="col">default</th></tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )
    else:
        shown = '<p class="note">Every setting is the method’s default.</p>'
    return section(
        "Configuration",
        "What differs from the defaults of the method.",
        shown + folded("All settings", f'<div class="config">{everything}</div>'),
    )


def made_with(source: Source) -> str:
    """The machine, the time it took and the software."""
    # Where the capture lay on the disk is nobody's business but the author's.
    facts = {key: value for key, value in source.versions.items() if key != "capture"}
    packages = facts.pop("packages", {})
    hardware = {key: facts.pop(key) for key in _HARDWARE if key in facts}
    metrics = source.metrics
    seconds, iterations = metrics.get("train_seconds"), metrics.get("iteration")
    time: dict[str, Any] = {}
    if seconds is not None:
        time["training"] = duration(seconds)
    if seconds and iterations:
        time["per iteration"] = f"{1000 * seconds / iterations:.0f} ms"
    if metrics.get("evaluate_seconds") is not None:
        time["evaluation"] = duration(metrics["evaluate_seconds"])
    named = [("machine", hardware), ("time", time), ("run", facts), ("software", packages)]
    blocks = "".join(_block(name, values) for name, values in named)
    return section("Made with", "", f'<div class="config">{blocks}</div>') if blocks else ""


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, as many of them as matter."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _changed(config: dict[str, Any]) -> list[tuple[str, Any, Any]] | None:
    """Key, value and default of what differs; None where the method is not known here."""
    values = dict(config)
    method = values.pop("method", None)
    if method not in TRAINABLE:
        return None
    defaults = dict(_flat(to_dict(method_config(method, {}, where="defaults"))))
    return [(k, v, defaults.get(k)) for k, v in _flat(values) if v != defaults.get(k)]


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
