"""The validator: everything that can be wrong with a capture, found before it costs a training."""

from pathlib import Path

from evsplat.capture.check_body import check_body
from evsplat.capture.check_events import check_events
from evsplat.capture.check_images import check_images
from evsplat.capture.finding import Finding, Findings
from evsplat.capture.metadata import Metadata
from evsplat.capture.parse import read_metadata


def validate_capture(path: Path | str, *, deep: bool = True) -> list[Finding]:
    """All faults of the capture at ``path``, errors and warnings.

    ``deep`` decodes every picture and scans every event; without it only descriptions, headers
    and poses are read (and sharp pictures are not opened at all).
    """
    return check_capture(Path(path), deep=deep)[1]


def check_capture(path: Path, *, deep: bool) -> tuple[Metadata | None, list[Finding]]:
    """`validate_capture` together with the metadata it read, None where that cannot be used."""
    findings = Findings()
    metadata = read_metadata(path, findings)
    if metadata is not None:
        check_images(metadata, findings, deep=deep)
        check_body(metadata, findings, deep=deep)
        check_events(metadata, findings, deep=deep)
    return metadata, findings.items
