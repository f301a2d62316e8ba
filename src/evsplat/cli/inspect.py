"""``evsplat inspect``: validate a capture or look into a recording, summarise and draw it."""

from pathlib import Path
from typing import Annotated

from evsplat.cli.options import CaptureFolder, Flag, option
from evsplat.errors import DataError


def inspect(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="inspect/CAPTURE")] = None,
    repair: Flag = False,
) -> None:
    """Validate a capture, or look into an event recording; sum it up and draw it.

    Draws frames, events, posed body, time and clocks, where there are any.

    Args:
        capture: Capture folder (docs/capture-format.md), or an event file of any format.
        out: Folder for the pictures.
        repair: Read on where an event file is damaged.
    """
    from evsplat.inspection import inspect as inspect_path

    name = capture.resolve().name
    report = inspect_path(capture, out or Path("inspect") / name, repair=repair)
    if not report.usable:
        raise DataError(report.summary)
    print(report.summary)
