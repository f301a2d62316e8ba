"""``evsplat restore``: a capture with sharp pictures in place of the blurry ones."""

from pathlib import Path
from typing import Annotated, Literal

from evsplat.cli.options import CaptureFolder, option


def restore(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-edi")] = None,
    method: Annotated[Literal["edi"], option("{edi}", default="edi", name="with")] = "edi",
    contrast_threshold: Annotated[
        tuple[float, float] | None, option("C+ C-", default="the capture's, or estimated")
    ] = None,
) -> None:
    """Write a new capture whose frames are sharp at mid-exposure.

    For methods that do not model blur. All but the frames stays as it is.

    Args:
        capture: Capture folder (docs/capture-format.md).
        out: The new capture.
        method: edi: event double integral, from each frame and its events.
        contrast_threshold: Log-intensity change per brighter and darker event.
    """
    from evsplat.restore import restore_capture

    target = out or capture.resolve().with_name(f"{capture.resolve().name}-{method}")
    written = restore_capture(capture, target, method=method, contrast_threshold=contrast_threshold)
    print(f"written: {written}")
