"""Captures without the masks that rows learn the person from, told before anything is trained."""

from collections.abc import Sequence
from contextlib import suppress

from evsplat.benching.cell import Cell
from evsplat.capture import Capture
from evsplat.capture.masked import command_for_lacking_masks, frames_without_masks
from evsplat.capture.validate import check_capture
from evsplat.errors import ConfigError


def unmasked(cells: Sequence[Cell]) -> list[str]:
    """A sentence per capture on which some of these cells will fail for want of masks.

    After the bench is too late: with masks the capture is another one, and no record of it fits.
    """
    by_capture: dict[str, list[Cell]] = {}
    for cell in cells:
        if _learns_from_masks(cell):
            by_capture.setdefault(cell.capture.name, []).append(cell)
    return [sentence for asking in by_capture.values() for sentence in _lacking(asking)]


def _learns_from_masks(cell: Cell) -> bool:
    """Of a recording; what is staged has masks."""
    with suppress(ConfigError):  # what is wrong with a row its record will say
        return cell.capture.stage is None and cell.policy.masks == "given"
    return False


def _lacking(cells: Sequence[Cell]) -> list[str]:
    """The sentence on the one capture of these cells; none where it has masks or cannot be read."""
    metadata, _ = check_capture(cells[0].capture.path, deep=False)
    if metadata is None:
        return []
    seen = Capture(metadata).for_training(cells[0].policy)
    without = frames_without_masks(seen)
    if not without:
        return []
    rows = ", ".join(dict.fromkeys(cell.row for cell in cells))
    return [
        f"{seen.path / 'capture.json'}: {len(without)} of {len(seen.train_frames)} training frames "
        f"have no mask, without which these rows fail: {rows}. Records are of the capture as it "
        f"is now, so make masks first: {command_for_lacking_masks(seen)}"
    ]
