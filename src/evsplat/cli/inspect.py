"""``evsplat inspect``: validate a capture, summarise and draw it."""

from pathlib import Path
from typing import Annotated

from evsplat.cli.options import CaptureFolder, option
from evsplat.errors import DataError


def inspect(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="inspect/CAPTURE")] = None,
) -> None:
    """Validate a capture, print a summary and draw it.

    Pictures: contact sheet, events over images, posed body over images, timeline.

    Args:
        capture: Capture folder (docs/capture-format.md).
        out: Folder for the pictures.
    """
    from evsplat.capture.inspect import inspect_capture

    report = inspect_capture(capture, out or Path("inspect") / capture.resolve().name)
    if not report.usable:
        raise DataError(report.summary)
    print(report.summary)
