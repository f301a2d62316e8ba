"""Restorers whose weights this machine lacks, told before anything is trained."""

from collections.abc import Sequence
from contextlib import suppress

from evsplat.benching.cell import Cell, restored_at
from evsplat.benching.folder import BenchFolder
from evsplat.errors import ConfigError
from evsplat.restore import RESTORERS
from evsplat.restore.network import Pretrained
from evsplat.weights import MissingWeights


def unweighted(cells: Sequence[Cell], folder: BenchFolder) -> list[str]:
    """A sentence per restorer for want of whose weights some of these cells will fail.

    A suite's rows of other restorers may train for hours before the first of them is tried.
    """
    rows: dict[str, list[str]] = {}
    for cell in cells:
        if _to_restore(cell, folder):
            rows.setdefault(str(cell.restore), []).append(cell.row)
    return [
        f"{reason} Without it these rows fail: {', '.join(dict.fromkeys(rows[name]))}."
        for name in rows
        if (reason := _lacking(name))
    ]


def _to_restore(cell: Cell, folder: BenchFolder) -> bool:
    """Whether nobody has restored its capture yet; what is restored needs no weights."""
    with suppress(ConfigError):  # what is wrong with a row its record will say
        return cell.restore is not None and not restored_at(folder, cell).exists()
    return False


def _lacking(name: str) -> str | None:
    restorer = RESTORERS.get(name)
    if isinstance(restorer, type) and issubclass(restorer, Pretrained):
        try:
            restorer.find()
        except MissingWeights as error:
            return str(error)
    return None
