"""Events on disk: slices against brute force, laziness, clocks and damaged files."""

import os
import pickle
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evsplat.errors import DataError, HeldOutError
from evsplat.events import ALWAYS, EventStore, EventStream, write_events
from evsplat.events import store as store_module

WIDTH, HEIGHT = 24, 18


def random_events(seed: int, count: int, length_us: int, first_us: int = 0) -> EventStream:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.integers(first_us, first_us + length_us, count))
    # bursts: many events in one microsecond and across a millisecond's edge
    times[count // 3 : count // 2] = times[count // 3] // 1000 * 1000 if count > 5 else times[0]
    polarity = rng.choice(np.array([-1, 1], dtype=np.int8), count)
    polarity[-1] = 1  # a file with darker events only would be one without polarity
    return EventStream(
        np.sort(times).astype(np.int64),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        polarity,
    )


def test_events_without_polarity_are_told_from_others(tmp_path: Path) -> None:
    events = random_events(3, 500, 60_000)
    write_events(tmp_path / "signed.h5", events)
    write_events(
        tmp_path / "blind.h5", EventStream(events.t, events.x, events.y, np.zeros_like(events.p))
    )
    signed, blind = (EventStore(tmp_path / f"{n}.h5", WIDTH, HEIGHT) for n in ("signed", "blind"))
    assert signed.has_polarity and not blind.has_polarity
    unsigned = blind.between(*blind.time_range_us)
    assert not unsigned.p.any() and np.array_equal(unsigned.t, events.t)


def test_what_was_decoded_is_not_looked_up_again(tmp_path: Path, monkeypatch) -> None:
    """HDF5 forgets the chunks of a data set that is closed, as one is that is opened to be read."""
    write_events(tmp_path / "events.h5", random_events(0, 500, 60_000))
    store = EventStore(tmp_path / "events.h5", WIDTH, HEIGHT)
    first = store.between(10_000, 20_000)
    monkeypatch.setattr(h5py.Group, "__getitem__", lambda *_: pytest.fail("opened again"))
    assert len(first) and same(store.between(10_000, 20_000), first)


@pytest.mark.parametrize("piece", [3, 1 << 20])
def test_counts_are_those_of_the_milliseconds_that_may_be_read(
    rng: np.random.Generator, tmp_path, monkeypatch, piece
) -> None:
    """Against brute force, with clocks apart by any number of microseconds."""
    monkeypatch.setattr(store_module, "INDEX_PIECE", piece)
    events, offset = random_events(int(rng.integers(10_000)), 800, 60_000), int(rng.integers(5_000))
    write_events(tmp_path / "events.h5", events)
    readable = [(ALWAYS[0], 15_200), (20_700, 40_100), (47_300, ALWAYS[1])]
    place, size = tmp_path / "events.h5", (WIDTH, HEIGHT)
    whole, store = (EventStore(place, *size, offset, None, spans) for spans in ([ALWAYS], readable))
    spans = [
        tuple(sorted(rng.integers(max(start, -9_000), min(end, 90_000) + 1, 2)))
        for start, end in readable
        for _ in range(20)
    ]
    t = whole.between(*whole.time_range_us).t
    for one, limits in ((whole, [ALWAYS] * len(spans)), (store, np.repeat(readable, 20, axis=0))):
        expected = []
        for (start, end), (low, high) in zip(spans, limits, strict=True):
            first_ms, last_ms = (start - offset) // 1000, -((offset - end) // 1000)
            within = (t >= max(low, 1000 * first_ms + offset)) & (t < 1000 * last_ms + offset)
            expected.append((within & (t < high)).sum())
        assert one.counts(np.array(spans)).tolist() == expected
    with pytest.raises(HeldOutError, match="events from 14000 to 15201 us"):
        store.counts(np.array([(14_000, 15_200), (14_000, 15_201)]))
    with pytest.raises(HeldOutError, match="events from 15300 to 15400 us"):
        store.counts(np.array([(15_300, 15_400)]))


def same(a: EventStream, b: EventStream) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("t", "x", "y", "p"))


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 3_000),
    first_us=st.integers(-5_000, 5_000),
    clock_offset_us=st.integers(-7_000, 7_000),
)
def test_slices_equal_brute_force_on_any_clock(
    tmp_path: Path, seed: int, count: int, first_us: int, clock_offset_us: int
) -> None:
    events = random_events(seed, count, 60_000, first_us)
    path = tmp_path / "events.h5"
    write_events(path, events)
    store = EventStore(path, WIDTH, HEIGHT, clock_offset_us)
    on_camera = EventStream(events.t + clock_offset_us, events.x, events.y, events.p)
    assert len(store) == count
    assert same(store.between(*store.time_range_us), on_camera)
    rng = np.random.default_rng(seed)
    for _ in range(15):
        start, end = rng.integers(-15_000, 80_000, 2)
        if rng.random() < 0.3:
            start, end = start // 1000 * 1000, end // 1000 * 1000
        assert same(store.between(int(start), int(end)), on_camera.between(start, end))
    store.close()


def write_with_its_own_times(path: Path, events: EventStream) -> None:
    """As the documentation shows it for h5py, without an offset for what is before 0."""
    milliseconds = np.arange(0, max(events.t[-1] // 1000 + 2, 1)) * 1000
    with h5py.File(path, "w") as file:
        for name, column in zip("txyp", (events.t, events.x, events.y, events.p > 0), strict=True):
            file[f"events/{name}"] = column.astype({"t": "i8", "p": "u1"}.get(name, "u2"))
        file["ms_to_idx"] = np.searchsorted(events.t, milliseconds).astype("u8")
        file["t_offset"] = np.int64(0)


@pytest.mark.parametrize("first_us", [-20_300, -90_000])
def test_times_before_zero_are_found_though_the_index_begins_there(
    rng: np.random.Generator, tmp_path: Path, first_us: int
) -> None:
    """Against brute force, of a recording that begins before 0, or is before it altogether."""
    events = random_events(int(rng.integers(10_000)), 800, 60_000, first_us)
    write_with_its_own_times(tmp_path / "events.h5", events)
    hidden = (first_us + 7_200, first_us + 9_100)
    readable = [(ALWAYS[0], hidden[0]), (hidden[1], ALWAYS[1])]
    whole = EventStore(tmp_path / "events.h5", WIDTH, HEIGHT)
    store = whole.restricted_to(readable)
    for one in (whole, whole.keeping(1 << 20)):
        for _ in range(30):
            start, end = map(int, np.sort(rng.integers(first_us - 5_000, first_us + 70_000, 2)))
            assert same(one.between(start, end), events.between(start, end))
    assert len(store) == len(events) - len(events.between(*hidden))
    edges, rate = whole.rate(13)
    assert np.allclose(rate * np.diff(edges) / 1e6, np.histogram(events.t, bins=edges)[0])
    spans = 1000 * np.sort(rng.integers(first_us // 1000, first_us // 1000 + 60, (20, 2)))
    assert whole.counts(spans).tolist() == [len(events.between(*span)) for span in spans.tolist()]


def test_times_stored_as_dsec_does_are_read(tmp_path: Path) -> None:
    """uint32 times from zero, the absolute start in t_offset."""
    events = random_events(1, 500, 20_000)
    path = tmp_path / "events.h5"
    write_events(path, events)
    with h5py.File(path, "r+") as file:
        t = file["events/t"][:]
        del file["events/t"], file["t_offset"]
        file["events/t"], file["t_offset"] = t.astype(np.uint32), np.int64(51_648_518_000)
    store = EventStore(path, WIDTH, HEIGHT, -51_648_518_000)
    assert same(store.between(3_000, 9_500), events.between(3_000, 9_500))


def test_empty_recording_gives_empty_slices(tmp_path: Path) -> None:
    empty = EventStream(*(np.zeros(0, dtype=d) for d in (np.int64, np.uint16, np.uint16, np.int8)))
    write_events(tmp_path / "events.h5", empty)
    store = EventStore(tmp_path / "events.h5", WIDTH, HEIGHT)
    assert len(store) == 0 and store.time_range_us == (0, 0)
    assert len(store.between(-1_000, 1_000_000)) == 0


def test_rate_integrates_to_the_count(tmp_path: Path) -> None:
    events = random_events(5, 4_000, 90_000, 1_234)
    write_events(tmp_path / "events.h5", events)
    store = EventStore(tmp_path / "events.h5", WIDTH, HEIGHT, clock_offset_us=77)
    edges, rate = store.rate(13)
    assert len(edges) == 14 and len(rate) == 13
    expected, _ = np.histogram(events.t + 77, bins=edges)
    assert np.allclose(rate * np.diff(edges) / 1e6, expected)
    assert expected.sum() == 4_000


def test_file_is_opened_at_first_read_and_survives_pickle_and_fork(tmp_path: Path) -> None:
    events = random_events(2, 1_000, 30_000)
    store = EventStore(tmp_path / "events.h5", WIDTH, HEIGHT)
    write_events(tmp_path / "events.h5", events)  # the file need not exist before it is read
    expected = store.between(5_000, 20_000)
    assert same(pickle.loads(pickle.dumps(store)).between(5_000, 20_000), expected)
    child = os.fork()
    if child == 0:
        # os._exit: the child must not run pytest's clean-up
        os._exit(0 if same(store.between(5_000, 20_000), expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert same(store.between(5_000, 20_000), expected)


def test_memory_of_a_slice_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    peaks = []
    for seconds in (1, 20):
        path = tmp_path / f"{seconds}.h5"
        count = 100_000 * seconds
        t = np.linspace(0, seconds * 1_000_000 - 1, count).astype(np.int64)
        zeros = np.zeros(count, dtype=np.uint16)
        write_events(path, EventStream(t, zeros, zeros, np.ones(count, dtype=np.int8)))
        store = EventStore(path, WIDTH, HEIGHT)
        tracemalloc.start()
        for start in range(0, seconds * 1_000_000, seconds * 100_000):
            assert len(store.between(start, start + 30_000)) == pytest.approx(3_000, abs=2)
        store.rate(50)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


def test_kept_events_are_those_on_disk_in_bounded_memory(tmp_path: Path) -> None:
    path, rows = tmp_path / "events.h5", store_module._KEPT_BLOCK
    write_events(path, random_events(7, 4 * rows, 900_000))
    lookup = np.random.default_rng(0).integers(-1, 5, (HEIGHT, WIDTH, 2)).astype(np.int32)
    spans = [(-100, 200_001), (400_000, 401_000), (500_003, 2_000_000)]
    for options in ({}, {"pixel_lookup": lookup}):
        store = EventStore(path, WIDTH, HEIGHT, 500, **options, readable_us=spans)
        kept = store.keeping(2 * rows * 13)
        for start, end in (
            (0, 200_001),
            (400_100, 400_900),
            (500_003, 950_000),
            (600_000, 600_000),
        ):
            assert same(kept.between(start, end), store.between(start, end))
            assert same(kept.between(start, end), store.between(start, end))
            assert len(kept._kept) <= 2
        with pytest.raises(HeldOutError):
            kept.between(0, 300_000)
    assert same(pickle.loads(pickle.dumps(kept)).between(0, 9_000), store.between(0, 9_000))


def test_disordered_events_between_kept_blocks_are_never_returned(tmp_path: Path) -> None:
    path, rows = tmp_path / "events.h5", store_module._KEPT_BLOCK
    write_events(path, random_events(4, rows + 100, 90_000))
    with h5py.File(path, "r+") as file:
        file["events/t"][rows] = file["events/t"][rows - 1] - 1
    store = EventStore(path, WIDTH, HEIGHT).keeping(1 << 30)
    with pytest.raises(DataError, match="is not ascending"):
        store.between(*store.time_range_us)


def test_disordered_events_are_never_returned(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    write_events(path, random_events(4, 1_000, 30_000))
    with h5py.File(path, "r+") as file:
        file["events/t"][700] = file["events/t"][699] - 1
    store = EventStore(path, WIDTH, HEIGHT)
    with pytest.raises(DataError, match=r"events/t\[700\] is earlier than the event before it"):
        store.between(*store.time_range_us)


def test_event_beyond_the_sensor_is_never_returned(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    events = random_events(4, 1_000, 30_000)
    events.x[640] = WIDTH
    write_events(path, events)
    with pytest.raises(DataError, match=f"event 640 is at x={WIDTH}"):
        EventStore(path, WIDTH, HEIGHT).between(0, 40_000)


def test_unsorted_events_are_not_written(tmp_path: Path) -> None:
    events = random_events(4, 10, 30_000)
    with pytest.raises(DataError, match="must be sorted"):
        write_events(
            tmp_path / "events.h5", EventStream(events.t[::-1], events.x, events.y, events.p)
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.95])
def test_truncated_file_is_a_data_error(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "events.h5"
    write_events(path, random_events(4, 50_000, 3_000_000))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(DataError, match="events.h5"):
        EventStore(path, WIDTH, HEIGHT).between(0, 3_000_000)


def test_missing_file_is_a_data_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="file not found"):
        len(EventStore(tmp_path / "none.h5", WIDTH, HEIGHT))
