"""Rows and columns in which a sensor, or its link, records nothing at all."""

import numpy as np
from jaxtyping import Int64

_WIDEST = 4
"""Lines together: of many there may as well be nothing that moves."""
_BUSY = 3
"""Events of a pixel that is not noise alone; hot pixels count as one like others."""
_MANY = 20
"""Busy pixels of a line that cannot all end at the one beside it."""
_LARGEST_SHARE = 1 / 8
"""Of the lines: more are those of a sensor coarser than the pixels that its events were put in."""
_MOST_TOLD = 6


def dead_rows(counts: Int64[np.ndarray, "H W"]) -> list[int]:
    """Numbers of the rows without an event between rows that have many.

    ``counts`` are events per pixel, of all of a recording. What moves sweeps over rows beside each
    other; those on either side have to be half as busy as rows with any event are on average.
    """
    busy, empty = (counts >= _BUSY).sum(1), ~counts.any(1)
    if empty.all():
        return []
    least = max(_MANY, float(busy[~empty].mean()) / 2)
    edges = np.diff(empty.astype(np.int8), prepend=0, append=0)
    found: list[int] = []
    for first, after in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        inside = first > 0 and after < len(counts) and after - first <= _WIDEST
        if inside and min(busy[first - 1], busy[after]) >= least:
            found += range(int(first), int(after))
    return found if len(found) <= _LARGEST_SHARE * len(counts) else []


def dead_lines_text(counts: Int64[np.ndarray, "H W"]) -> str:
    """Such as "rows 12, 40; column 7", some numbers of either; empty where none is."""
    parts = []
    for name, across in (("row", counts), ("column", counts.T)):
        if lines := dead_rows(across):
            more = f" and {len(lines) - _MOST_TOLD} more" if len(lines) > _MOST_TOLD else ""
            shown = ", ".join(map(str, lines[:_MOST_TOLD]))
            parts.append(f"{name}{'s' if len(lines) > 1 else ''} {shown}{more}")
    return "; ".join(parts)
