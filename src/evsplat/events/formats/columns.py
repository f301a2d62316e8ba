"""Which column or key of a table of events is which, and what its times are in."""

from collections.abc import Iterable, Mapping

import numpy as np

from evsplat.errors import DataError

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "tE"),
    "x": ("x", "xs", "col", "xE"),
    "y": ("y", "ys", "row", "yE"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "is_increase", "pE"),
}
_PER_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
_MAX_SECONDS = 1e10
# uint64 above 2**63 and wrong units end here, before they are cast
_MAX_TIME_US = float(1 << 60)


def match_names(given: Iterable[str], wanted: Mapping[str, str] | None = None) -> dict[str, str]:
    """Component (t, x, y, p) -> its name among ``given``; components not found are left out."""
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
            f"{where}: times up to {float(t.max()):g} are taken for seconds; give time_unit (s, "
            "ms, us or ns)."
        )
    if len(t) and max(-float(t.min()), float(t.max())) * _PER_US[unit] > _MAX_TIME_US:
        raise DataError(
            f"{where}: times from {t.min()} to {t.max()} {unit} are beyond any recording; check "
            "the file or time_unit."
        )
    if t.dtype.kind == "f":
        return np.rint(t * _PER_US[unit]).astype(np.int64)
    t = t.astype(np.int64, copy=False)
    return t // 1000 if unit == "ns" else t if unit == "us" else t * int(_PER_US[unit])


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
