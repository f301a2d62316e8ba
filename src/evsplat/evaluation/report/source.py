"""The evaluated run that a report is made of: its files and its capture."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from evsplat.capture import Capture
from evsplat.commands import command
from evsplat.config import load_yaml
from evsplat.errors import DataError
from evsplat.evaluation.splits import name_of
from evsplat.methods.reconstruction import Reconstruction
from evsplat.options.runs import Split
from evsplat.pages import read_rgb
from evsplat.untrusted.records import misfit
from evsplat.untrusted.text import parse_json, read_json, read_text

_NUMBER = (float, type(None))
_DRAWN = {
    "loss": _NUMBER,
    "terms": {str: _NUMBER},
    "psnr": _NUMBER,
    "human": _NUMBER,
    "scene": _NUMBER,
    "nominal": _NUMBER,
}
"""What is shown of a line of log.jsonl, where it has it."""


@dataclass(frozen=True)
class Source:
    """An evaluated run, read from its folder."""

    folder: Path
    capture: Capture
    reconstruction: Reconstruction
    metrics: dict[str, Any]
    log: list[dict[str, Any]]
    """Lines of log.jsonl; empty for methods that do not train."""
    config: dict[str, Any]
    versions: dict[str, Any]

    @classmethod
    def read(
        cls,
        folder: Path,
        capture: Capture,
        reconstruction: Reconstruction,
        split: Split = "test",
    ) -> "Source":
        """Read the files of an evaluated run; only the split's metrics.json must be there."""
        metrics_file = folder / name_of("metrics", split, ".json")
        if not metrics_file.is_file():
            option = () if split == "test" else ("--split", split)
            raise DataError(
                f"{metrics_file}: file not found; first run {command('evaluate', folder, *option)}."
            )
        config, versions = folder / "config.yaml", folder / "versions.json"
        return cls(
            folder,
            capture,
            reconstruction,
            _read_object(metrics_file),
            _read_log(folder / "log.jsonl"),
            load_yaml(config) if config.is_file() else {},
            _read_object(versions) if versions.is_file() else {},
        )

    def picture(self, path: str) -> UInt8[np.ndarray, "H W 3"]:
        """A picture that the evaluation wrote, by its path inside the run folder."""
        return read_rgb(self.folder / path, "evaluate the run again")


def _read_object(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict):
        raise DataError(f"{path}: holds a {type(values).__name__}, expected an object of JSON.")
    return values


def _read_log(path: Path) -> list[dict[str, Any]]:
    """The lines that are whole: a run that was killed may end in the middle of one."""
    if not path.is_file():
        return []
    entries = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        entry = None
        with suppress(ValueError):
            entry = parse_json(line)
        if not isinstance(entry, dict):
            continue
        drawn = {key: shape for key, shape in _DRAWN.items() if key in entry}
        wrong = misfit(entry, {"iteration": int, **drawn})
        if wrong:
            raise DataError(f"{path}: line {number}: {wrong}; remove the line.")
        entries.append(entry)
    return entries
