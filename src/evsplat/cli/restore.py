"""``evsplat restore``: a capture with sharp pictures in place of the blurry ones."""

from pathlib import Path
from typing import Annotated, Any, Literal

from evsplat.cli.options import CaptureFolder, Device, option
from evsplat.errors import ConfigError


def restore(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-edi")] = None,
    method: Annotated[
        Literal["edi", "pienet"], option("{edi,pienet}", default="edi", name="with")
    ] = "edi",
    contrast_threshold: Annotated[
        tuple[float, float] | None, option("C+ C-", default="the capture's, or estimated")
    ] = None,
    device: Device = "auto",
) -> None:
    """Write a new capture whose frames are sharp at mid-exposure.

    For methods that do not model blur. All but the frames stays as it is.

    Args:
        capture: Capture folder (docs/capture-format.md).
        out: The new capture.
        method: edi: event double integral, from each frame and its events; pienet: a network.
        contrast_threshold: For edi: log-intensity change per brighter and darker event.
        device: For networks: where they run.
    """
    from evsplat.restore import restore_capture

    options: dict[str, Any] = {}
    if method == "edi":
        options["contrast_threshold"] = contrast_threshold
    else:
        if contrast_threshold is not None:
            raise ConfigError(
                f"--contrast-threshold belongs to --with edi, not to {method}; leave it out."
            )
        options["device"] = device
    target = out or capture.resolve().with_name(f"{capture.resolve().name}-{method}")
    print(f"written: {restore_capture(capture, target, method=method, **options)}")
