"""Typed access to JSON objects, with findings that say where a value is wrong."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.capture.finding import Findings, nearest
from evsplat.names import NAME_RULE, is_name, is_path_of_names, leads_out
from evsplat.untrusted.faults import brief

MISSING = object()
RENAME = "Rename it: files may be named after it."
# Integers up to here are exact as doubles.
_LARGEST = 2**53


class Fields:
    """One JSON object; what is missing or ill-typed in it becomes a finding."""

    def __init__(
        self, file: Path, where: str, value: Any, known: tuple[str, ...], findings: Findings
    ) -> None:
        self.file, self.where, self.findings = file, where, findings
        self.value = value if isinstance(value, dict) else {}
        self.is_object = self.valid = isinstance(value, dict)
        if not self.is_object:
            self.fail("", brief(value), "a JSON object", "Write it as { ... }.")
        for key in self.value:
            if key not in known:
                findings.warning(
                    file, self.field(key), "an unknown key", "a known key", nearest(key, known)
                )

    @property
    def folder(self) -> Path:
        """Folder of the capture, which the object's paths are relative to."""
        return self.file.parent

    def inner(self, where: str, value: Any, known: tuple[str, ...]) -> "Fields":
        """An object further in, of the same file."""
        return Fields(self.file, where, value, known, self.findings)

    def field(self, key: str) -> str:
        """Dotted name of a key of this object."""
        return f"{self.where}.{key}".strip(".")

    def fail(self, key: str, found: str, expected: str, remedy: str) -> None:
        """Note an error of this object, which makes it invalid."""
        self.valid = False
        self.findings.error(self.file, self.field(key), found, expected, remedy)

    def has(self, key: str) -> bool:
        """True where the key has a value; a finding where it has none."""
        there = self.value.get(key) is not None
        if not there and self.is_object:
            found = "null" if key in self.value else "nothing"
            self.fail(key, found, "a value", f"Add the key {key!r}.")
        return there

    def get(self, key: str, default: Any = MISSING) -> Any:
        """The raw value; None (and a finding, unless there is a default) where it is missing."""
        if default is not MISSING:
            return self.value.get(key, default)
        return self.value[key] if self.has(key) else None

    def text(self, key: str, default: Any = MISSING) -> str:
        """A non-empty text, "" after a finding."""
        value = self.get(key, default)
        if value is not None and (not isinstance(value, str) or not value):
            self.fail(key, brief(value), "a text", "Write it in quotation marks.")
        return value if isinstance(value, str) else ""

    def name(self, key: str) -> str:
        """A text that may become a file's name, "" after a finding."""
        text = self.text(key)
        if not text or is_name(text):
            return text
        self.fail(key, brief(text), f"a name: {NAME_RULE}", RENAME)
        return ""

    def choice(self, key: str, choices: Collection[str]) -> Any:
        """One of the choices; None where it is missing, and after a finding."""
        value = self.get(key, None)
        if value is None or value in choices:
            return value
        self.fail(key, brief(value), f"one of {list(choices)}", "Correct it.")
        return None

    def path(self, key: str, *, required: bool = True) -> Path | None:
        """A path below the capture's folder, which no link leads out of."""
        text = self.text(key) if required else self.text(key, None)
        if not text:
            return None
        found = brief(text)
        if is_path_of_names(text):
            if not leads_out(self.folder / text, self.folder):
                return self.folder / text
            found += ", a link that leads out of it"
        self.fail(
            key,
            found,
            "a path below the capture's folder: names of at most 200 bytes with '/' between",
            "Put the file into the folder and name it from there.",
        )
        return None

    def integer(self, key: str, default: Any = MISSING, *, minimum: int | None = None) -> int:
        """A whole number, 0 after a finding."""
        value = self.get(key, default)
        if value is None:
            return 0
        if not is_whole(value):
            self.fail(key, brief(value), f"a whole number up to {_LARGEST:g}", "Correct it.")
            return 0
        if minimum is not None and value < minimum:
            self.fail(key, brief(value), f"a number of at least {minimum}", "Correct it.")
        return int(value)

    def numbers(self, key: str, shape: tuple[int, ...], default: Any = MISSING) -> Any:
        """Finite numbers of that shape as float64, None after a finding."""
        value = self.get(key, default)
        if value is None:
            return None
        expected = f"{'x'.join(map(str, shape))} finite numbers up to {_LARGEST:g}"
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            array = np.empty(0)
        # also refuses NaN, and numbers that would overflow further on
        if array.shape != shape or not (np.abs(array) <= _LARGEST).all():
            self.fail(key, brief(value), expected, "Correct it.")
            return None
        return array

    def entries(self, key: str, default: Any = MISSING) -> list[Any]:
        """A list, empty after a finding."""
        value = self.get(key, default)
        if value is not None and not isinstance(value, list):
            self.fail(key, brief(value), "a list", "Write it as [ ... ].")
        return value if isinstance(value, list) else []


def is_whole(value: Any) -> bool:
    """True for a JSON integer that a double holds exactly."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= _LARGEST and int(value) == value
