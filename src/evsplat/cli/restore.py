"""``evsplat restore``: a capture with sharp pictures in place of the blurry ones."""

from pathlib import Path
from typing import Annotated, Any, Literal

from evsplat.cli.options import CaptureFolder, Device, Use, option
from evsplat.errors import ConfigError

Method = Literal["edi", "nafnet", "mprnet", "efnet", "d2net", "e2vid", "pienet"]


def restore(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-NAME")] = None,
    method: Annotated[Method, option("NAME", default="edi", name="with")] = "edi",
    contrast_threshold: Annotated[
        tuple[float, float] | None, option("C+ C-", default="the capture's, or estimated")
    ] = None,
    weights: Annotated[
        Path | None, option("FILE", default="EVSPLAT_NAME, or torch's cache")
    ] = None,
    device: Device = "auto",
    use: Use = "training",
) -> None:
    """Write a new capture whose frames are sharp at mid-exposure.

    For methods that do not model blur. All but the frames stays as it is.

    Args:
        capture: Capture folder (docs/capture-format.md).
        out: The new capture.
        method: edi (event double integral), or a network: nafnet, mprnet (no events), efnet,
            d2net (both), e2vid, pienet (brightness from events); docs/restore.md.
        contrast_threshold: For edi: log-intensity change per brighter and darker event.
        weights: For networks but pienet: the published checkpoint, which you bring.
        device: For networks: where they run.
        use: What training frames are restored from; everything looks at held-out frames too.
    """
    from evsplat.capture import Policy
    from evsplat.restore import restore_capture

    given: dict[str, tuple[bool, Any]] = {
        "contrast_threshold": (method == "edi", contrast_threshold),
        "weights": (method not in ("edi", "pienet"), weights),
        "device": (method != "edi", None if method == "edi" and device == "auto" else device),
    }
    for name, (fits, value) in given.items():
        if value is not None and not fits:
            raise ConfigError(
                f"--{name.replace('_', '-')} means nothing to --with {method}; leave it out."
            )
    options = {name: value for name, (_, value) in given.items() if value is not None}
    target = out or capture.resolve().with_name(f"{capture.resolve().name}-{method}")
    written = restore_capture(capture, target, method=method, policy=Policy(use=use), **options)
    print(f"written: {written}")
