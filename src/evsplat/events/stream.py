"""A slice of an event recording in memory."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int8, Int64, UInt16


@dataclass(frozen=True, eq=False)
class EventStream:
    """Events sorted by time, one array per component, all of length N."""

    t: Int64[np.ndarray, "N"]
    """Microseconds on the camera's clock, ascending."""
    x: UInt16[np.ndarray, "N"]
    """Column, 0 at the left."""
    y: UInt16[np.ndarray, "N"]
    """Row, 0 at the top."""
    p: Int8[np.ndarray, "N"]
    """Polarity: +1 brighter, -1 darker; 0 throughout where the sensor does not say."""

    def __len__(self) -> int:
        """Count of events."""
        return len(self.t)

    def between(self, start_us: int, end_us: int) -> "EventStream":
        """Events with ``start_us <= t < end_us``, as views of the same arrays."""
        first, last = np.searchsorted(self.t, [start_us, end_us], side="left")
        return self.take(slice(first, max(first, last)))

    def take(self, which: np.ndarray | slice) -> "EventStream":
        """The events of a slice, a mask or indices, in that order."""
        return EventStream(self.t[which], self.x[which], self.y[which], self.p[which])

    @staticmethod
    def joined(parts: Sequence["EventStream"]) -> "EventStream":
        """Consecutive parts as one stream; empty where there are none."""
        kinds = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.int8}
        columns = (
            np.concatenate([np.zeros(0, kind), *(getattr(part, name) for part in parts)])
            for name, kind in kinds.items()
        )
        return EventStream(*columns)
