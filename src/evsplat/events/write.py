"""Writing event recordings, whole or piece by piece: HDF5, .npz, .csv and Prophesee's EVT 2."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from evsplat.errors import ConfigError, DataError
from evsplat.events.stream import EventStream
from evsplat.events.writers import CsvWriter, Evt2Writer, Hdf5Writer, NpzWriter, Writer
from evsplat.files import atomic_path

_SUFFIXES = {
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".npz": "npz",
    ".csv": "csv",
    ".txt": "csv",
    ".raw": "evt2",
}
WRITTEN_FORMATS = ("hdf5", "npz", "csv", "evt2")


def write_events(
    path: Path | str,
    events: EventStream | Iterable[EventStream],
    *,
    format: str | None = None,
    width: int | None = None,
    height: int | None = None,
    compression_level: int = 4,
    attributes: Mapping[str, str | int | float] | None = None,
) -> int:
    """Write a recording, whole or not at all; gives the count of events.

    ``events`` is one stream or its consecutive pieces, which are written as they come: memory does
    not grow with the length of the recording.

    Args:
        path: The file; its suffix chooses the format: .h5 and .hdf5 (as `EventStore` reads them),
            .npz (t, x, y, p), .csv and .txt (named columns), .raw (EVT 2).
        events: Sorted events.
        format: "hdf5", "npz", "csv" or "evt2", whatever the suffix.
        width: Columns of the sensor, written down where the format has a place for it.
        height: Rows of the sensor, likewise.
        compression_level: Of HDF5, 0 to 9.
        attributes: Of HDF5: where the events come from, kept as the file's attributes; readers
            use ``width`` and ``height``.

    Raises:
        DataError: Times that go back, within a piece or from one to the next, or events that the
            format cannot hold.
        ConfigError: No such format.
    """
    path = Path(path)
    if format is None and path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            f"{path}: the suffix names no format that evsplat writes ({', '.join(_SUFFIXES)}); "
            f"choose one with format: {', '.join(WRITTEN_FORMATS)}."
        )
    format = format or _SUFFIXES[path.suffix.lower()]
    if format not in WRITTEN_FORMATS:
        raise ConfigError(f"format is {format!r}, expected one of {', '.join(WRITTEN_FORMATS)}.")
    size = None if width is None or height is None else (width, height)
    told = {**(attributes or {}), **({"width": width, "height": height} if size else {})}
    makers: dict[str, Callable[[Path], Writer]] = {
        "hdf5": lambda temporary: Hdf5Writer(temporary, told, compression_level),
        "npz": lambda temporary: NpzWriter(temporary, size),
        "csv": lambda temporary: CsvWriter(temporary, size),
        "evt2": lambda temporary: Evt2Writer(temporary, size, path),
    }
    last_us: int | None = None
    count = 0
    with atomic_path(path) as temporary, makers[format](temporary) as writer:
        for piece in (events,) if isinstance(events, EventStream) else events:
            if not len(piece):
                continue
            back = (np.diff(piece.t) < 0).any() or (last_us is not None and piece.t[0] < last_us)
            if back:
                raise DataError(f"{path}: events must be sorted by t before they are written.")
            writer.append(piece)
            last_us, count = int(piece.t[-1]), count + len(piece)
        writer.finish()
    return count
