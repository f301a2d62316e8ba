"""Writing events in pieces."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from evsplat.events import EventStore, EventStream, write_events


@pytest.mark.parametrize("first_us", [-123_456, 0, 1_700_000_000_000_000])
def test_pieces_of_a_recording_give_the_file_of_the_whole(tmp_path: Path, first_us: int) -> None:
    """Index and columns do not depend on how the recording is cut, also far from time zero."""
    rng = np.random.default_rng(2)
    count = 4_000
    t = np.sort(rng.integers(0, 150_000, count)) + first_us
    t[1_000:1_500] = t[1_000]  # a burst, so that pieces end within a microsecond
    t.sort()
    x, y = (rng.integers(0, 20, count).astype(np.uint16) for _ in range(2))
    whole = EventStream(t, x, y, rng.choice(np.array([-1, 1], np.int8), count))
    cuts = [0, 0, *np.sort(rng.integers(0, count, 30)).tolist(), count]
    pieces = (
        EventStream(t[a:b], x[a:b], y[a:b], whole.p[a:b])
        for a, b in zip(cuts, cuts[1:], strict=False)
    )
    assert write_events(tmp_path / "whole.h5", whole) == count
    assert write_events(tmp_path / "pieces.h5", pieces) == count
    for name in ("whole", "pieces"):
        path = tmp_path / f"{name}.h5"
        assert path.stat().st_size < 100_000
        store = EventStore(path, 20, 20)
        assert store.time_range_us == (t[0], t[-1] + 1)
        for start in rng.integers(t[0] - 5_000, t[-1], 20).tolist():
            read, window = (s.between(start, start + 7_777) for s in (store, whole))
            for column in "txyp":
                assert np.array_equal(getattr(read, column), getattr(window, column))


def test_attributes_stay_with_the_file(tmp_path: Path) -> None:
    empty = EventStream(*(np.zeros(0, dtype=d) for d in (np.int64, np.uint16, np.uint16, np.int8)))
    told = {"width": 20, "simulated": True, "contrast": 0.2, "source": "clip.mp4"}
    write_events(tmp_path / "events.h5", empty, attributes=told)
    with h5py.File(tmp_path / "events.h5") as file:
        assert dict(file.attrs) == told
