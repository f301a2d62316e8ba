"""Events that come as a table of numbers (text, NumPy): names, units, polarity, order."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import SAY_COLUMNS, SAY_UNIT, RawEvents
from evsplat.options import ReadOptions

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "tE"),
    "x": ("x", "xs", "col", "xE"),
    "y": ("y", "ys", "row", "yE"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "is_increase", "pE"),
}
_PER_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
_UNIT_WORDS = {"s": "second", "ms": "millisecond", "us": "microsecond", "ns": "nanosecond"}
_MAX_SECONDS = 1e10
# uint64 above 2**63 and wrong units end here, before they are cast
_MAX_TIME_US = float(1 << 60)
_ORDERS = {4: ("txyp", "xytp", "xypt"), 3: ("txy", "xyt")}
NO_POLARITY = "polarity is 0 throughout: the recording says that pixels changed, not how"


class Table:
    """Components of equal length, as `RawEvents` on demand."""

    def __init__(
        self, path: Path, components: Mapping[str, np.ndarray], time_unit: str | None
    ) -> None:
        self.notes: list[str] = []
        self._columns = dict(components)
        self._path = path
        lengths = {name: column.shape for name, column in components.items()}
        if len(set(lengths.values())) != 1 or any(len(s) != 1 for s in lengths.values()):
            text = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
            raise DataError(f"{path}: its components differ in length or are not 1-D ({text}).")
        for name, column in components.items():
            if column.dtype.kind not in "iufb":
                raise DataError(f"{path}: {name} is of type {column.dtype}, expected numbers.")
        t = self._columns["t"]
        self.unit = time_unit or guess_time_unit(t)
        if time_unit is None and self.unit != "us":
            self.notes.append(assumed_unit(self.unit))
        if "p" not in components:
            self.has_polarity = False
            self.notes.append("no polarity: the recording says that pixels changed, not how")
        else:
            self.has_polarity = not len(t) or bool(np.any(components["p"]))
            if not self.has_polarity:
                self.notes.append(NO_POLARITY)

    def __len__(self) -> int:
        return len(self._columns["t"])

    def events(self, part: slice, first: int = 0) -> RawEvents:
        """Events of a slice; ``first`` is the index of its first event, for errors."""
        where = str(self._path)
        t = to_microseconds(self._columns["t"][part], self.unit, where, first)
        x, y = (to_whole(self._columns[name][part], name, where, first) for name in "xy")
        if "p" in self._columns:
            p = to_polarity(self._columns["p"][part], where, first)
        else:
            p = np.zeros(len(t), dtype=np.int8)
        return RawEvents(t, x, y, p)


def to_polarity(values: np.ndarray, where: str, first: int) -> np.ndarray:
    """Polarity as bool or int8 in -1, 0, 1."""
    if values.dtype.kind == "b":
        return values
    values = to_whole(values, "p", where, first)
    strange = (values > 1) | (values < -1) if values.dtype.kind == "i" else values > 1
    if strange.any():
        at = int(np.argmax(strange))
        raise DataError(
            f"{where}: polarity of event {first + at} is {values[at]}, expected 0 and 1, or -1 and "
            f"1; name the columns with {SAY_COLUMNS}."
        )
    return values.astype(np.int8)


def table_order(path: Path, table: np.ndarray, options: ReadOptions) -> str:
    """Components in the order of the columns, such as "txyp", where only one order fits.

    Times ascend, pixels are whole numbers on the sensor (or below 65,536), polarity is -1, 0, 1.
    """
    if len(table) == 0:
        return _ORDERS.get(table.shape[1], ("",))[0]
    fits = [
        order
        for order in _ORDERS.get(table.shape[1], ())
        if _fits({name: table[:, i] for i, name in enumerate(order)}, options)
    ]
    if len(fits) != 1:
        found = f"could be {' or '.join(fits)}" if fits else "are of no known order"
        raise DataError(
            f"{path}: its {table.shape[1]} columns {found}; say which is which with {SAY_COLUMNS}."
        )
    return fits[0]


def _fits(named: dict[str, np.ndarray], options: ReadOptions) -> bool:
    limits = {"x": options.width or 1 << 16, "y": options.height or 1 << 16}
    for name, limit in limits.items():
        values = named[name]
        if not ((values >= 0) & (values < limit) & (values == np.floor(values))).all():
            return False
    if "p" in named and not np.isin(named["p"], (-1, 0, 1)).all():
        return False
    t = named["t"]
    falls = int((np.diff(t.astype(np.float64)) < 0).sum())
    # a recording to be repaired may fall now and then
    return falls <= (len(t) // 10 if options.repair else 0)


def match_names(given: Iterable[str], wanted: Mapping[str, str] | None = None) -> dict[str, str]:
    """Component (t, x, y, p) to its name among ``given``; components not found are left out."""
    given = list(given)
    lower = {name.lower(): name for name in reversed(given)}
    found = {}
    for component, candidates in NAMES.items():
        if wanted and component in wanted:
            if wanted[component] in given:
                found[component] = wanted[component]
            continue
        for candidate in candidates:
            if candidate in given or candidate.lower() in lower:
                found[component] = candidate if candidate in given else lower[candidate.lower()]
                break
    return found


def names_pixels(given: Iterable[str]) -> bool:
    """Whether names are those of t, x and y at least."""
    return {"t", "x", "y"} <= set(match_names(given))


def assumed_unit(unit: str) -> str:
    """The note that times are read in a unit that the file does not tell."""
    return f"times are taken for {unit}; if they are not, write the file anew with {SAY_UNIT}"


def assumed_order(order: Iterable[str]) -> str:
    """The note that columns are read in an order in which x and y may be exchanged."""
    return (
        f"columns without names are taken for {','.join(order)}; if they are not, say which is "
        f"which with {SAY_COLUMNS}"
    )


def unit_called(word: str) -> str | None:
    """The time unit of a name or a sign; None where it is another."""
    word = word.replace("µ", "u").replace("μ", "u")  # the sign of micro and the Greek letter
    fits = (unit for unit, name in _UNIT_WORDS.items() if word in (unit, name, f"{name}s"))
    return next(fits, None)


def guess_time_unit(t: np.ndarray) -> str:
    """Integers are microseconds (nanoseconds above 1e17), numbers with a fraction are seconds."""
    if t.dtype.kind in "iu" or not (t != np.floor(t)).any():
        return "ns" if len(t) and np.abs(t[0]) > 1e17 else "us"
    return "s"


def to_microseconds(t: np.ndarray, unit: str, where: str, first: int = 0) -> np.ndarray:
    """Times as int64 microseconds, rounded; ``first`` is the index of t[0], for errors."""
    if t.dtype.kind == "f":
        t = t.astype(np.float64)
        finite = np.isfinite(t)
        if not finite.all():
            at = int(np.argmin(finite))
            raise DataError(f"{where}: time of event {first + at} is {t[at]}, expected a number.")
    if unit == "s" and len(t) and float(np.abs(t).max()) > _MAX_SECONDS:
        raise DataError(
            f"{where}: times up to {float(t.max()):g} are taken for seconds; give their unit "
            f"with {SAY_UNIT}."
        )
    if len(t) and max(-float(t.min()), float(t.max())) * _PER_US[unit] > _MAX_TIME_US:
        raise DataError(
            f"{where}: times from {t.min()} to {t.max()} {unit} are beyond any recording; check "
            f"the file, or give {SAY_UNIT}."
        )
    if t.dtype.kind == "f":
        return np.rint(t * _PER_US[unit]).astype(np.int64)
    t = t.astype(np.int64, copy=False)
    if unit == "ns":  # halves away from zero, as texts are rounded
        return np.sign(t) * ((np.abs(t) + 500) // 1000)
    return t if unit == "us" else t * int(_PER_US[unit])


def to_whole(values: np.ndarray, name: str, where: str, first: int = 0) -> np.ndarray:
    """Integers as they are; floats must be whole numbers."""
    if values.dtype.kind in "iu":
        return values
    whole = np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 1 << 40)
    if values.dtype.kind != "f" or not whole.all():
        at = int(np.argmin(whole))
        raise DataError(
            f"{where}: {name} of event {first + at} is {values[at]}, expected a whole number."
        )
    return values.astype(np.int64)
