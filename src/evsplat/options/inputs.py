"""Folders and files that a verb reads: whether they are there, told before torch is loaded."""

import os
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.training_sign import is_training

_NAMED_RUNS = 5


@dataclass(frozen=True)
class Input:
    """Marks an option whose path must lead to something that exists."""

    check: Callable[[Path], None]
    """Raises a `DataError` where it does not."""


def check_inputs(verb: Any) -> None:
    """Check each field of ``verb`` that is marked as an `Input`, a path or None.

    A verb that is no dataclass is passed over.
    """
    if not is_dataclass(verb):
        return
    hints = get_type_hints(type(verb), include_extras=True)
    for field in fields(verb):
        path = getattr(verb, field.name)
        for mark in getattr(hints[field.name], "__metadata__", ()):
            if isinstance(mark, Input) and path is not None:
                mark.check(path)


def no_capture(path: Path) -> tuple[Path, str, str, str] | None:
    """What is missing where ``path`` is no capture folder; None where it may be one.

    The file, what was found, what was expected, and what to do.
    """
    if os.path.isfile(path):
        remedy = "Videos and recordings become one by 'evsplat import' (docs/import.md)."
        if path.name == "capture.json":
            remedy = f"Give the folder that it lies in: {path.parent}."
        return path, "a file", "a capture folder", remedy
    if not os.path.isdir(path):
        return path, "no such folder", "a capture folder", "Check the path."
    file = path / "capture.json"
    if not os.path.lexists(file):
        expected = "the capture's description as a JSON object"
        return file, "no such file", expected, "Is this a capture folder?"
    return None


def check_capture_folder(path: Path) -> None:
    """Raise a `DataError` where no capture can be at ``path``."""
    missing = no_capture(path)
    if missing:
        file, found, expected, remedy = missing
        raise DataError(f"{file}: found {found}, expected {expected}. {remedy}")


def check_run_folder(path: Path) -> None:
    """Raise a `DataError` that names the runs one level below where ``path`` is no run.

    A run whose training still prepares its first step is none yet.
    """
    if (path / "config.yaml").exists():
        return
    if is_training(path):
        raise DataError(
            f"{path}: its training is still being prepared, expected one that has made a step; "
            "wait for the first one, or open 'evsplat view', which waits by itself."
        )
    if (path / "capture.json").exists():
        train = command("train", path, "--out", "RUN")
        raise DataError(f"{path}: a capture, expected a run; make one of it with: {train}.")
    raise DataError(f"{path}: not a run folder, config.yaml is missing.{_runs_below(path)}")


def check_run_or_training(path: Path) -> None:
    """As `check_run_folder`, where a training that prepares its first step will do as well."""
    if not is_training(path):
        check_run_folder(path)


def check_file(path: Path) -> None:
    """Raise a `DataError` where nothing is at ``path``."""
    if not path.exists():
        raise DataError(f"{path}: file not found.")


def check_footage(path: Path) -> None:
    """Raise a `DataError` where neither a video nor a folder of pictures can be."""
    if not path.exists():
        raise DataError(f"{path}: no such video file or folder of pictures.")


def check_capture_or_recording(path: Path) -> None:
    """Raise a `DataError` where ``path`` is neither a file nor a folder that holds either."""
    is_recording = path.is_file() and path.name != "capture.json"
    if not is_recording and not (path / "metadata.yaml").is_file():
        check_capture_folder(path)


def _runs_below(path: Path) -> str:
    """A sentence that names the runs one level below, the newest first; empty where none is."""
    runs = sorted(path.glob("*/config.yaml"), key=lambda file: -file.stat().st_mtime)
    if not runs:
        return ""
    names = ", ".join(str(file.parent) for file in runs[:_NAMED_RUNS])
    return f" A run lies below: {names}." if len(runs) == 1 else f" Runs lie below: {names}."
