"""Event slices and count maps against plain numpy."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from evsplat.errors import DataError
from evsplat.events import EventStream, count_map


def random_stream(seed: int, count: int, width: int = 20, height: int = 15) -> EventStream:
    rng = np.random.default_rng(seed)
    return EventStream(
        np.sort(rng.integers(-500, 20_000, count)).astype(np.int64),
        rng.integers(0, width, count).astype(np.uint16),
        rng.integers(0, height, count).astype(np.uint16),
        rng.choice(np.array([-1, 1], dtype=np.int8), count),
    )


@given(st.integers(0, 10_000), st.integers(-1_000, 21_000), st.integers(-1_000, 21_000))
def test_between_keeps_start_and_drops_end(seed: int, start: int, end: int) -> None:
    stream = random_stream(seed, 200)
    part = stream.between(start, end)
    keep = (stream.t >= start) & (stream.t < end)
    for name in ("t", "x", "y", "p"):
        assert np.array_equal(getattr(part, name), getattr(stream, name)[keep])


@given(st.integers(0, 10_000), st.integers(0, 300))
def test_count_map_is_a_signed_histogram(seed: int, count: int) -> None:
    stream = random_stream(seed, count)
    expected, _, _ = np.histogram2d(
        stream.y, stream.x, bins=(15, 20), range=((0, 15), (0, 20)), weights=stream.p
    )
    counted = count_map(stream, 15, 20)
    assert counted.dtype == torch.float32
    assert np.array_equal(counted.numpy(), expected)


def test_adjacent_windows_add_up_to_the_whole() -> None:
    stream = random_stream(3, 500)
    cuts = [-500, 0, 1, 7_000, 7_000, 20_000]
    parts = [count_map(stream.between(a, b), 15, 20) for a, b in zip(cuts, cuts[1:], strict=False)]
    assert torch.equal(torch.stack(parts).sum(0), count_map(stream, 15, 20))


def test_event_outside_of_the_map_is_refused() -> None:
    with pytest.raises(DataError, match="x=19.*outside of a map of 19x15"):
        count_map(EventStream(*(np.array([v]) for v in (0, 19, 3, 1))), height=15, width=19)
