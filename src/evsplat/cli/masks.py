"""``evsplat masks``: find the person in each frame of a capture."""

from pathlib import Path
from typing import Annotated, Any, Literal

from evsplat.cli.options import CaptureFolder, Flag, Use, option
from evsplat.errors import ConfigError


def masks(
    capture: CaptureFolder,
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-masked")] = None,
    in_place: Flag = False,
    method: Annotated[
        Literal["background", "silhouette", "rvm"],
        option("{background,silhouette,rvm}", default="background", name="with"),
    ] = "background",
    threshold: Annotated[float | None, option("T", default="from the noise")] = None,
    margin: Annotated[float | None, option("PIXELS", default="0")] = None,
    weights: Annotated[Path | None, option("FILE", default="EVSPLAT_RVM, or torch's cache")] = None,
    use: Use = "training",
) -> None:
    """Find the person in each frame: soft masks for baselines and evaluation.

    Training of this project's own methods needs none.

    Args:
        capture: Capture folder (docs/capture-format.md).
        out: The new capture, with these masks in place of any it had.
        in_place: Add the masks to the capture itself, if it has no others.
        method: Difference to a static background, posed body, or RobustVideoMatting.
        threshold: For background: least difference, 0 to 1.
        margin: For silhouette: widen the body for clothes and hair.
        weights: For rvm: the network's TorchScript file, which you bring.
        use: What masks of training frames are made from; everything looks at held-out ones too.
    """
    from evsplat.capture import Policy
    from evsplat.masks import mask_capture

    given: dict[str, tuple[str, Any]] = {
        "threshold": ("background", threshold),
        "margin": ("silhouette", margin),
        "weights": ("rvm", weights),
    }
    for name, (owner, value) in given.items():
        if value is not None and owner != method:
            raise ConfigError(f"--{name} belongs to --with {owner}, not to {method}; leave it out.")
    if in_place and out is not None:
        raise ConfigError("give --out or --in-place, not both.")
    target = None
    if not in_place:
        target = out or capture.resolve().with_name(f"{capture.resolve().name}-masked")
    renamed = {"margin": "margin_px"}
    options = {
        renamed.get(name, name): value for name, (_, value) in given.items() if value is not None
    }
    written = mask_capture(capture, target, method=method, policy=Policy(use=use), **options)
    print(f"written: {written}")
