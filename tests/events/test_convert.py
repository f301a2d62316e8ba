"""Writing every format and reading it back, whole and in pieces, and the verb that does both."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evsplat.cli import main
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStore, EventStream, open_recording, read_events, write_events
from evsplat.events.convert import convert_recording
from evsplat.events.store import ALWAYS

from .formats.helpers import HEIGHT, WIDTH, random_stream, same

SUFFIXES = [".h5", ".npz", ".csv", ".raw"]


def _pieces(s: EventStream, seed: int) -> Iterator[EventStream]:
    cuts = np.random.default_rng(seed).integers(0, len(s), 20).tolist()
    cuts = sorted([0, 0, *cuts, len(s)])
    for a, b in zip(cuts, cuts[1:], strict=False):
        yield EventStream(s.t[a:b], s.x[a:b], s.y[a:b], s.p[a:b])


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("first_us", [0, 7_000_000_000])
def test_what_is_written_in_pieces_is_read_back(tmp_path: Path, suffix: str, first_us: int) -> None:
    s = random_stream(first_us % 97, 5_000, first_us=first_us)
    whole, pieces = tmp_path / f"whole{suffix}", tmp_path / f"pieces{suffix}"
    assert write_events(whole, s, width=WIDTH, height=HEIGHT) == 5_000
    assert write_events(pieces, _pieces(s, 3), width=WIDTH, height=HEIGHT) == 5_000
    for path in (whole, pieces):
        recording = open_recording(path)
        assert (recording.width, recording.height) == (WIDTH, HEIGHT)
        assert recording.notes == []
        assert same(recording.read(), s)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_streams_that_are_darker_throughout_keep_their_polarity(
    rng: np.random.Generator, tmp_path: Path, suffix: str
) -> None:
    s = random_stream(int(rng.integers(1 << 30)), 500)
    s = EventStream(s.t, s.x, s.y, np.full_like(s.p, -1))
    first, last = tmp_path / f"e{suffix}", tmp_path / "events.h5"
    write_events(first, s, width=WIDTH, height=HEIGHT)
    assert same(read_events(first), s)
    convert_recording(first, last)
    store = EventStore(last, WIDTH, HEIGHT)
    assert store.has_polarity
    middle_us = int(s.t[250])
    assert not store.restricted_to([(ALWAYS[0], middle_us)]).has_polarity
    assert same(store.between(*store.time_range_us), s)


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".csv"])
def test_streams_without_polarity_stay_so(tmp_path: Path, suffix: str) -> None:
    s = random_stream(1, 500)
    s = EventStream(s.t, s.x, s.y, np.zeros_like(s.p))
    write_events(tmp_path / f"e{suffix}", s)
    recording = open_recording(tmp_path / f"e{suffix}")
    assert not recording.has_polarity
    assert same(recording.read(), s)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_empty_recording_is_read_as_one(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"e{suffix}"
    assert write_events(path, iter(())) == 0
    recording = open_recording(path)
    assert recording.has_polarity and len(recording.read()) == 0


def test_numpy_reads_the_arrays_too(tmp_path: Path) -> None:
    s = random_stream(2, 300)
    write_events(tmp_path / "e.npz", _pieces(s, 0), width=WIDTH, height=HEIGHT)
    with np.load(tmp_path / "e.npz") as arrays:
        assert set(arrays) == {"t", "x", "y", "p", "width", "height"}
        assert same(EventStream(*(arrays[name] for name in ("t", "x", "y", "p"))), s)


def test_evt2_refuses_what_it_cannot_say(tmp_path: Path) -> None:
    s = random_stream(3, 100)
    for bad, message in (
        (EventStream(s.t + 2**40, s.x, s.y, s.p), "34 bits.*--from-zero"),
        (EventStream(s.t, s.x + np.uint16(2000), s.y, s.p), "11 bits"),
        (EventStream(s.t, s.x, s.y, s.p * np.int8(0)), "no polarity"),
    ):
        with pytest.raises(DataError, match=message):
            write_events(tmp_path / "e.raw", bad)
    assert list(tmp_path.iterdir()) == []


def test_unknown_suffix_and_disorder_are_errors_that_leave_nothing(tmp_path: Path) -> None:
    s = random_stream(4, 100)
    with pytest.raises(ConfigError, match="names no format"):
        write_events(tmp_path / "e.mat", s)
    for suffix in SUFFIXES:
        with pytest.raises(DataError, match="must be sorted"):
            write_events(tmp_path / f"e{suffix}", iter([s, s]))
    assert list(tmp_path.iterdir()) == []


def test_command_converts_repairs_and_says_what_it_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    s = random_stream(5, 1_000, first_us=10**15)
    write_events(tmp_path / "in.csv", s, width=WIDTH, height=HEIGHT)
    text = (tmp_path / "in.csv").read_text().splitlines()
    text[500], text[501] = text[501], text[500]
    (tmp_path / "in.csv").write_text("\n".join(text) + "\n123")
    source, out = str(tmp_path / "in.csv"), str(tmp_path / "out.raw")
    assert main(["convert", source, out]) == 2
    message = capsys.readouterr().err
    assert "in.csv: " in message and "--repair" in message and "Traceback" not in message
    assert not Path(out).exists()
    assert main(["convert", source, out, "--repair", "--from-zero"]) == 0
    printed = capsys.readouterr().out
    assert f"written: {out}" in printed and "1,000 events" in printed and "320 x 240" in printed
    assert "repaired: sorts events that are out of order (1)" in printed
    assert same(read_events(out), EventStream(s.t - s.t[0], s.x, s.y, s.p))


def test_polarities_are_exchanged_where_there_are_any(
    rng: np.random.Generator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    s = random_stream(int(rng.integers(1_000)), 2_000)
    write_events(tmp_path / "e.raw", s, width=WIDTH, height=HEIGHT)
    for source, out, p in (("e.raw", "other.csv", -s.p), ("other.csv", "again.h5", s.p)):
        assert main(["convert", str(tmp_path / source), str(tmp_path / out), "--invert"]) == 0
        assert same(read_events(tmp_path / out), EventStream(s.t, s.x, s.y, p))
    write_events(tmp_path / "none.npz", EventStream(s.t, s.x, s.y, 0 * s.p))
    assert main(["convert", str(tmp_path / "none.npz"), str(tmp_path / "x.h5"), "--invert"]) == 2
    assert "none.npz has no polarity to exchange" in capsys.readouterr().err
    assert not (tmp_path / "x.h5").exists()


def test_a_recording_is_not_converted_onto_itself_unless_that_is_asked_for(
    rng: np.random.Generator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    s = random_stream(int(rng.integers(1_000)), 3_000)
    for name in ("e.npz", "e.h5", "e.csv", "e.raw"):
        path = tmp_path / name
        write_events(path, s)
        with pytest.raises(ConfigError, match="is the recording itself.* by --in-place"):
            convert_recording(path, path)
        assert main(["convert", str(path), "--in-place", "--invert"]) == 0
        assert same(read_events(path), EventStream(s.t, s.x, s.y, -s.p))
        before = path.read_bytes()
        for wrong in ([], [str(tmp_path / "out.h5"), "--in-place"]):
            assert main(["convert", str(path), *wrong]) == 2
            assert "give OUT, the file to write, or --in-place" in capsys.readouterr().err
        # stopped on the way, it stays as it was
        assert main(["convert", str(path), "--in-place", "--to", "evt2", "--width", "9"]) == 2
        assert path.read_bytes() == before
    assert sorted(one.suffix for one in tmp_path.iterdir()) == [".csv", ".h5", ".npz", ".raw"]


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Traced from EVT 2 to HDF5, .npz and .csv, of half a million and of two million events."""
    peaks: dict[str, list[int]] = {}
    for millions in (0.5, 2.0):
        s = random_stream(7, int(1e6 * millions), gap_us=3)
        source = tmp_path / f"{millions}.raw"
        write_events(source, s, width=WIDTH, height=HEIGHT)
        del s
        for suffix in (".h5", ".npz"):
            tracemalloc.start()
            convert_recording(source, tmp_path / f"out{suffix}")
            peaks.setdefault(suffix, []).append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    for short, long in peaks.values():
        assert long < 1.3 * short


@pytest.mark.parametrize(
    "name", ["davis346.aedat4", "evt3.raw", "IMU_translBoxes.aedat", "test_events_1.bag"]
)
def test_real_recordings_become_event_stores(
    recordings_root: Path, tmp_path: Path, name: str
) -> None:
    conversion = convert_recording(recordings_root / name, tmp_path / "events.h5")
    s = read_events(recordings_root / name)
    assert conversion.events == len(s)
    assert (conversion.start_us, conversion.end_us) == (s.t[0], s.t[-1])
    assert conversion.width is not None and conversion.height is not None
    store = EventStore(tmp_path / "events.h5", conversion.width, conversion.height)
    middle = int(s.t[len(s) // 2])
    assert same(store.between(middle, middle + 50_000), s.between(middle, middle + 50_000))
