"""A limit on the time that a descent takes, and a bar that shows how far it is."""

import math
import time
from collections.abc import Iterator
from typing import Any

from tqdm import tqdm


class TimeLimit:
    """Shares the time that is left among descents, each by its part of the steps still planned.

    A descent that would take longer goes through its schedule in fewer steps, so that it ends with
    small ones; at least one is taken.
    """

    def __init__(self, seconds: float | None, planned: int, *, progress: bool = False) -> None:
        """``seconds``, from now on, None for no limit; ``planned``: steps of all descents."""
        self._end = math.inf if seconds is None else time.monotonic() + seconds
        self._planned = planned
        self._bar: Any = tqdm(
            desc="refinement",
            total=planned,
            leave=False,
            mininterval=1,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}",
            disable=not progress,
        )

    def steps(self, count: int, size: int = 1) -> Iterator[float]:
        """Places in the schedule, from 0 to below 1, of the steps of a descent of ``count``.

        ``size``: how many of the planned steps each of them takes as long as.
        """
        begun = time.monotonic()
        planned = count * size
        allowed = max(0.0, self._end - begun) * planned / max(planned, self._planned)
        place, done = 0.0, 0
        while place < 1:
            yield place
            done += 1
            taken = (time.monotonic() - begun) / allowed if allowed > 0 else 1.0
            following = min(1.0, max(done / count, taken))
            # Rounded parts may be more than the whole, of which tqdm warns.
            left = self._bar.total - self._bar.n
            self._bar.update(min(planned * (following - place), left))
            place = following
        self._planned -= planned

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()
