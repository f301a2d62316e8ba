"""What stands on a floor, one upright strip in each column of a picture.

Badino, Franke and Pfeiffer, The Stixel World (DAGM 2009): all columns together by dynamic
programming, of one picture's colours in place of measured distances.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

_BEND, _BREAK, _END = 0.6, 6.0, 7.5
"""Prices, logarithms of likelihoods, from a column to the next: of each row by which a foot or an
upper end is elsewhere, of another thing, and of a thing's side where nothing is beside it."""
_NEVER = -1e6

Ends = tuple[int, int]


def stixels(
    gains: Float[np.ndarray, "H W"],
    edges: Float[np.ndarray, "H W"],
    floor: Bool[np.ndarray, "H W"],
    risen: Bool[np.ndarray, "H W"],
) -> list[Ends | None]:
    """Upper row and lowest one of what stands in each column, or None.

    ``gains``: logarithm of how much likelier each place is a thing than what is behind it.
    ``edges``: gain of an end between a row and the next. A foot is where there is ``floor``, of
    which each column has the rows from some row on, and an upper end where it has ``risen``.
    """
    height, width = gains.shape
    if not floor.any():
        return [None] * width
    first = int(floor.any(1).argmax())
    above = np.concatenate([np.zeros((1, width)), np.cumsum(gains, 0)])
    at_top = np.concatenate([np.zeros((1, width)), edges[:-1]]) - above[:-1]
    at_foot = (edges + above[1:])[first:]
    things: list[Float[np.ndarray, "F T"]] = []
    none = [0.0]
    for column in range(width):
        pairs = at_foot[:, column, None] + at_top[None, :, column]
        allowed = floor[first:, column, None] & risen[None, :, column]
        own = np.where(allowed, pairs, _NEVER).astype(np.float32)
        if not things:
            things.append(own - _END)
            continue
        before, best = things[-1], float(things[-1].max())
        stay = np.maximum(_bent(before), max(best - _BREAK, none[-1] - _END))
        things.append(stay + own)
        none.append(max(none[-1], best - _END))
    return _way_back(things, none, first)


def _bent(values: Float[np.ndarray, "F T"]) -> Float[np.ndarray, "F T"]:
    """Most of all values less `_BEND` times how many rows and columns they are away."""
    for axis in (0, 1):
        ramp = _BEND * np.arange(values.shape[axis], dtype=np.float32)
        ramp = ramp[:, None] if axis == 0 else ramp[None]
        forth = np.maximum.accumulate(values + ramp, axis) - ramp
        back = np.flip(np.maximum.accumulate(np.flip(values - ramp, axis), axis), axis) + ramp
        values = np.maximum(forth, back)
    return values


def _way_back(
    things: list[Float[np.ndarray, "F T"]], none: list[float], first: int
) -> list[Ends | None]:
    """The best choice in each column, given the one after it."""
    feet, tops = np.ogrid[: things[0].shape[0], : things[0].shape[1]]
    found: list[Ends | None] = []
    after: Ends | None = None
    for values, nothing in zip(reversed(things), reversed(none), strict=True):
        to_none = 0.0
        if found and after is None:
            values = values - _END
        elif after is not None:
            away: Int[np.ndarray, "F T"] = abs(feet + first - after[1]) + abs(tops - after[0])
            values = np.maximum(values - _BEND * away, values - _BREAK)
            to_none = _END
        foot, top = np.unravel_index(int(values.argmax()), values.shape)
        after = (int(top), int(foot) + first)
        if nothing - to_none >= values[foot, top]:
            after = None
        found.append(after)
    return found[::-1]
