"""A slice of an event recording in memory."""

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
        part = slice(first, max(first, last))
        return EventStream(self.t[part], self.x[part], self.y[part], self.p[part])
