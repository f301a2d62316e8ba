"""`evsplat masks`: person masks for a capture, in a new one or in itself."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

import evsplat
from evsplat.capture import Capture, Frame, Policy, load_capture
from evsplat.capture.derive import derived_capture, training_frames_first, write_picture
from evsplat.config import to_dict
from evsplat.errors import ConfigError, DataError, OutputError
from evsplat.files import new_folder, refuse_existing, remove_folder, try_target, write_json
from evsplat.masks.base import MASKERS, Masker
from evsplat.untrusted.text import read_json


def mask_capture(
    path: Path | str,
    out: Path | str | None = None,
    *,
    method: str = "background",
    policy: Policy | None = None,
    **options: Any,
) -> Path:
    """Find the person in each frame and write soft masks (0 to 255); gives the capture's folder.

    With ``out`` a new capture is written, whole or not at all, with these masks in place of any.
    Without, the masks are added to the capture itself: to a folder of their own, which capture.json
    names as the very last step; masks that were made otherwise are never replaced. How they were
    made is in ``provenance.masks``. ``options`` are those of the masker.

    Masks of training frames are made from what ``policy`` lets training see. Those of held-out
    frames, which only the evaluation opens, are made from everything, by what the masker learned
    from the training frames.

    Raises:
        ConfigError: No masker has that name.
        DataError: ``out`` exists, the capture has other masks already, or it lacks what the masker
            needs.
    """
    if method not in MASKERS:
        raise ConfigError(f"no masks are named {method!r}, expected {' or '.join(MASKERS)}.")
    capture = load_capture(path)
    if out is None:
        _check_in_place(capture)
    else:
        refuse_existing(Path(out))
    try_target(capture.path / "masks" if out is None else out)
    seen = capture.for_training(policy or Policy())
    masker = MASKERS[method](seen, **options)
    found = training_frames_first(capture, seen, masker.masks)
    masks = tqdm(found, "masks", len(capture.frames), unit="frame")
    made = {"with": masker.name, **masker.provenance(), "evsplat": evsplat.__version__}
    made["policy"] = to_dict(seen.policy)
    if out is None:
        _write_in_place(capture, masker, masks, made)
        return capture.path
    with derived_capture(capture, out, without=("mask",)) as making:
        for frame, mask in masks:
            making.set_picture(frame, "mask", mask)
        making.document["provenance"] = {**capture.provenance, "masks": made}
    return Path(out)


def _check_in_place(capture: Capture) -> None:
    if capture.has_others_masks:
        raise DataError(
            f"{capture.path}: has masks already that evsplat did not make, so they stay; write a "
            "new capture with --out."
        )
    if not capture.takes_masks:
        raise DataError(
            f"{capture.path}: its lens distorts, and masks are made without distortion; write a "
            "new capture with --out."
        )


def _write_in_place(
    capture: Capture,
    masker: Masker,
    masks: Iterable[tuple[Frame, Float[Tensor, "H W"]]],
    made: dict[str, Any],
) -> None:
    folder = _free_name(capture.path, f"masks-{masker.name}")
    description = capture.path / "capture.json"
    document = read_json(description)
    masked: dict[str, str] = {}
    with new_folder(folder) as temporary:
        for frame, mask in masks:
            name = f"{frame.index:04d}-{frame.image.stem}.png"
            write_picture(temporary / name, mask)
            masked[frame.name] = f"{folder.name}/{name}"
        if read_json(description) != document:
            raise DataError(f"{description}: was changed while masks were made; make them again.")
    for entry in document["frames"]:
        entry["mask"] = masked[entry["name"]]
    document["provenance"] = {**capture.provenance, "masks": made}
    try:
        write_json(description, document)
    except OutputError:
        with suppress(OutputError):
            remove_folder(folder)  # which nothing names
        raise


def _free_name(parent: Path, stem: str) -> Path:
    """``stem`` or, where that is taken, with a number."""
    name, number = parent / stem, 1
    while name.exists():
        number += 1
        name = parent / f"{stem}-{number}"
    return name
