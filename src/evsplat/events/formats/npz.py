""".npz and .npy files with one array per component, or one table of them; never unpickled."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import (
    BLOCK_EVENTS,
    SAY_COLUMNS,
    RawEvents,
    Source,
)
from evsplat.events.formats.table import NAMES, Table, assumed_order, match_names, table_order
from evsplat.options import ReadOptions
from evsplat.untrusted.arrays import read_plain_arrays
from evsplat.untrusted.faults import brief

_SIZE_KEYS = (("width", "height"), ("sensor_width", "sensor_height"))


class Npz(Source):
    """Arrays of a NumPy file; all of them are in memory while it is open."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        arrays = read_plain_arrays(self.path)
        named = _components(self.path, arrays, options, self.notes)
        self._table = Table(self.path, named, options.time_unit)
        self.has_polarity = self._table.has_polarity
        self.notes += self._table.notes
        for wide, high in _SIZE_KEYS:
            if all(key in arrays and arrays[key].size == 1 for key in (wide, high)):
                self.width, self.height = (
                    _pixels(self.path, key, arrays[key]) for key in (wide, high)
                )

    def blocks(self) -> Iterator[RawEvents]:
        """Slices of the arrays."""
        for first in range(0, len(self._table), BLOCK_EVENTS):
            yield self._table.events(slice(first, first + BLOCK_EVENTS), first)


def _pixels(path: Path, key: str, array: np.ndarray) -> int:
    """The one number of an array, a side of the sensor."""
    value = array.item()
    if array.dtype.kind not in "iuf" or not 0 < value <= 1 << 16:
        raise DataError(
            f"{path}: {key} is {brief(value)}, expected a side of the sensor, 1 to 65536 pixels; "
            "write the file anew."
        )
    return int(value)


def _components(
    path: Path, arrays: dict[str, np.ndarray], options: ReadOptions, notes: list[str]
) -> dict[str, np.ndarray]:
    """t, x, y and, where there is one, p; ``notes`` get what was assumed."""
    columns = options.columns
    if isinstance(columns, Mapping):
        missing = sorted(set(columns.values()) - set(arrays))
        if missing:
            raise DataError(f"{path}: has no key {missing[0]!r} (has {', '.join(arrays)}).")
    wanted = columns if isinstance(columns, Mapping) else None
    tables = [a for a in arrays.values() if a.ndim == 2 and a.shape[1] in (3, 4, 5)]
    structured = [a for a in arrays.values() if a.dtype.names]
    if structured:
        arrays = {name: structured[0][name] for name in structured[0].dtype.names or ()}
    found = {key: arrays[name] for key, name in match_names(arrays, wanted).items()}
    pairs = next((arrays[key] for key in ("xy", "coords", "pixels") if key in arrays), None)
    if pairs is not None and pairs.ndim == 2 and 2 in pairs.shape:
        pairs = pairs if pairs.shape[1] == 2 else pairs.T
        found |= {"x": pairs[:, 0], "y": pairs[:, 1]}
    if {"t", "x", "y"} <= set(found):
        return found
    if len(tables) == 1 and not found:
        order = columns if isinstance(columns, tuple) else table_order(path, tables[0], options)
        if columns is None:
            notes.append(assumed_order(order))
        if len(order) != tables[0].shape[1]:
            raise DataError(
                f"{path}: its table has {tables[0].shape[1]} columns, --columns names {len(order)}."
            )
        named = {name: tables[0][:, i] for i, name in enumerate(order) if name in NAMES}
        if not {"t", "x", "y"} <= set(named):
            raise DataError(
                f"{path}: --columns is {','.join(order)}, expected t, x, y and perhaps p, and '-' "
                "for what to pass over."
            )
        return named
    shapes = ", ".join(f"{key} {array.shape}" for key, array in arrays.items())
    raise DataError(
        f"{path}: no events found among its arrays ({shapes}); expected t, x, y, p (or xy, t, "
        f"p, or one table), or say which is which with {SAY_COLUMNS}."
    )
