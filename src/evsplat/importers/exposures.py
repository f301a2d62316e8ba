"""exposures.txt: when the shutter opened and closed for each picture of a recording."""

from pathlib import Path

import numpy as np
from jaxtyping import Int64

from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_table

_MOST_US = float(1 << 60)


def read_exposures(path: Path, pictures: int) -> Int64[np.ndarray, "N 2"]:
    """Start and end of every exposure, whole microseconds, one after the other in time.

    Raises:
        DataError: Not so many lines of two numbers, or a line that is no exposure.
    """
    expected = (
        f"expected start and end in microseconds of each of the {pictures} pictures, a line each, "
        "with a blank between"
    )
    try:
        rows = read_table(path)
    except ValueError as error:
        raise DataError(f"{path}: not a table of numbers ({error.args[0]}); {expected}.") from None
    if rows.shape != (pictures, 2):
        raise DataError(f"{path}: has {len(rows)} lines of {rows.shape[-1]} numbers, {expected}.")
    before = -np.inf
    for line, (start, end) in enumerate(rows, start=1):
        found = f"{path}: line {line} of numbers is {start:.12g} {end:.12g}"
        if not (abs(start) < _MOST_US and abs(end) < _MOST_US and end - start >= 1):
            raise DataError(
                f"{found}, expected when the shutter opened and when it closed, in microseconds; "
                "correct it."
            )
        if start <= before:
            raise DataError(
                f"{found}, expected a start after {before:.12g}, that of the line before; sort the "
                "lines as the pictures are, by name."
            )
        before = start
    return np.rint(rows).astype(np.int64)
