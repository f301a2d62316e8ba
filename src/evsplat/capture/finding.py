"""Faults that the validator found: the file, the field, what is there and what to do."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

from evsplat.errors import DataError
from evsplat.untrusted.faults import shortened
from evsplat.wording import begun

_LONGEST = 400
"""Letters of what is found in a file that fit a message."""


@dataclass(frozen=True)
class Finding:
    """One fault of a capture."""

    severity: Literal["error", "warning"]
    """An error makes the capture unusable, a warning does not."""
    file: Path
    field: str
    """Place in the file, e.g. ``frames[3].exposure_us``; empty for the file as a whole."""
    found: str
    expected: str
    remedy: str

    def __str__(self) -> str:
        where = f"{self.file}: {self.field}" if self.field else f"{self.file}"
        return f"{where}: found {self.found}, expected {self.expected}. {self.remedy}"


@dataclass
class Findings:
    """Collects findings in the order in which they are met."""

    items: list[Finding] = field(default_factory=list)

    def error(self, file: Path, field: str, found: str, expected: str, remedy: str) -> None:
        """Add an error to the findings."""
        found = shortened(found, _LONGEST)
        self.items.append(Finding("error", file, field, found, expected, remedy))

    def warning(self, file: Path, field: str, found: str, expected: str, remedy: str) -> None:
        """Add a warning to the findings."""
        found = shortened(found, _LONGEST)
        self.items.append(Finding("warning", file, field, found, expected, remedy))

    def error_count(self) -> int:
        """Count of the errors so far."""
        return sum(item.severity == "error" for item in self.items)


def refuse_errors(
    findings: Iterable[Finding], place: Callable[[Path], Path] = lambda file: file
) -> None:
    """Raise a `DataError` with the first error, if any; its file is at ``place(file)`` later."""
    for finding in findings:
        if finding.severity == "error":
            raise DataError(f"{replace(finding, file=place(finding.file))}")


def reason_and_remedy(error: DataError, file: Path) -> tuple[str, str]:
    """The parts of what a reader says of a file, ``FILE: reason; remedy.``; "" for no remedy."""
    reason, mark, remedy = str(error).removeprefix(f"{file}: ").rpartition("; ")
    if not mark:
        return remedy, ""
    return reason, begun(remedy)


def nearest(key: str, known: tuple[str, ...]) -> str:
    """A hint with the known key that looks most like ``key``."""
    by_lower_case = {name.lower(): name for name in known}
    closest = get_close_matches(key.lower(), by_lower_case, n=1, cutoff=0.0)[0]
    return f"Did you mean {by_lower_case[closest]!r}? Otherwise remove it."
