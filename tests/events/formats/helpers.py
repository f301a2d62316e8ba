"""Random events, equality, and encoders written from the formats' descriptions."""

import numpy as np

from evsplat.events import EventStream

WIDTH, HEIGHT = 320, 240


def random_stream(seed: int, count: int, *, gap_us: int = 30, first_us: int = 0) -> EventStream:
    """Ascending times with repeats, pixels on a sensor of WIDTH x HEIGHT, both polarities."""
    rng = np.random.default_rng(seed)
    return EventStream(
        first_us + np.cumsum(rng.integers(0, gap_us, count)).astype(np.int64),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        rng.choice(np.array([-1, 1], dtype=np.int8), count),
    )


def same(a: EventStream, b: EventStream) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        and getattr(a, name).dtype == getattr(b, name).dtype
        for name in ("t", "x", "y", "p")
    )
