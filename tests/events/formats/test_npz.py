"""NumPy files in the key sets of the field."""

import gzip
from pathlib import Path

import h5py
import numpy as np
import pytest

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, read_events

from .helpers import WIDTH, random_stream, same


def _variants(s: EventStream) -> dict[str, dict[str, np.ndarray]]:
    t, x, y, p = s.t, s.x, s.y, s.p
    table = np.stack([t, x, y, p], axis=1)
    return {
        "x/y/t/p": {"x": x, "y": y, "t": t, "p": p},
        "bool": {"x": x, "y": y, "t": t, "p": p > 0},
        "0/1": {"x": x, "y": y, "t": t, "p": (p > 0).astype(np.uint8)},
        "0/1 signed": {"x": x, "y": y, "t": t, "p": (p > 0).astype(np.int64)},
        "ts/pol": {"xs": x.astype(np.int32), "ys": y, "ts": t.astype(np.uint64), "pol": p},
        "xy": {"xy": np.stack([x, y], axis=1), "t": t, "p": p},
        "ExFMan": {"tE": t, "xE": x, "yE": y, "pE": p},
        "t x y p": {"events": table},
        "x y t p": {"arr_0": table[:, [1, 2, 0, 3]]},
        "x y p t": {"arr_0": table[:, [1, 2, 3, 0]]},
        "floats": {"events": table.astype(np.float64)},
        "seconds": {"x": x, "y": y, "t": t * 1e-6, "p": p},
        "nanoseconds": {"x": x, "y": y, "t": t * 1000 + 10**18, "p": p},
    }


@pytest.mark.parametrize("name", _variants(random_stream(0, 2)))
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_key_sets_and_polarities_give_the_same_events(tmp_path: Path, name: str, save) -> None:
    stream = random_stream(3, 2_000, first_us=50)
    save(tmp_path / "events.npz", **_variants(stream)[name])
    read = read_events(tmp_path / "events.npz")
    shift = 10**15 if name == "nanoseconds" else 0
    assert same(EventStream(read.t - shift, read.x, read.y, read.p), stream)


@pytest.mark.parametrize("kind", ["i8", "f8"])
def test_nanoseconds_are_rounded_in_tables_as_in_texts(
    rng: np.random.Generator, tmp_path: Path, kind: str
) -> None:
    s = random_stream(6, 400)
    t_ns = np.sort(rng.integers(-(10**6), 10**6, 400)) | 1  # no half of a microsecond
    np.savez(tmp_path / "e.npz", t=t_ns.astype(kind), x=s.x, y=s.y, p=s.p)
    rows = zip(t_ns, s.x, s.y, s.p, strict=True)
    lines = ["t,x,y,p", *(",".join(map(str, row)) for row in rows)]
    (tmp_path / "e.csv").write_text("\n".join(lines) + "\n")
    array, text = (read_events(tmp_path / name, time_unit="ns") for name in ("e.npz", "e.csv"))
    assert np.array_equal(array.t, np.rint(t_ns / 1000))
    assert same(array, text)


def test_structured_and_plain_npy(tmp_path: Path) -> None:
    s = random_stream(4, 500)
    fields = [("timestamp", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "?")]
    table = np.array(list(zip(s.t, s.x, s.y, s.p > 0, strict=True)), dtype=fields)
    np.save(tmp_path / "a.npy", table)
    assert same(read_events(tmp_path / "a.npy"), s)
    np.save(tmp_path / "b.npy", np.asfortranarray(np.stack([s.t, s.x, s.y, s.p], axis=1)))
    assert same(read_events(tmp_path / "b.npy"), s)


def test_all_zero_polarity_is_recognised_as_none(tmp_path: Path) -> None:
    s = random_stream(5, 300)
    np.savez(tmp_path / "e.npz", xy=np.stack([s.x, s.y], 1), t=s.t, p=np.zeros(300, dtype=np.int8))
    recording = open_recording(tmp_path / "e.npz")
    assert not recording.has_polarity and "polarity is 0 throughout" in recording.notes[0]
    assert not recording.read().p.any()


def test_ambiguous_table_asks_for_columns(tmp_path: Path) -> None:
    table = np.array([[1, 1, 1, 1], [2, 2, 2, 0]])
    np.save(tmp_path / "e.npy", table)
    with pytest.raises(DataError, match="could be txyp or xytp.*columns"):
        open_recording(tmp_path / "e.npy")
    read = read_events(tmp_path / "e.npy", columns="t,x,y,p")
    assert read.t.tolist() == [1, 2] and read.p.tolist() == [1, -1]


@pytest.mark.parametrize("suffix", [".npy", ".csv", ".h5"])
def test_the_order_that_is_taken_of_columns_without_names_is_told(
    tmp_path: Path, suffix: str
) -> None:
    """Of t, y, x, p the x and y were exchanged without a word."""
    s = random_stream(7, 300)
    table = np.stack([s.t, s.y, s.x, s.p], axis=1)
    path = tmp_path / f"e{suffix}"
    if suffix == ".npy":
        np.save(path, table)
    elif suffix == ".csv":
        np.savetxt(path, table, fmt="%d", delimiter=",")
    else:
        with h5py.File(path, "w") as file:
            file["events"] = table
    notes = open_recording(path, width=WIDTH, height=WIDTH).notes
    assert [note for note in notes if "taken for t,x,y,p; if they are not" in note]
    with pytest.raises(DataError, match="are of no known order; say which is which"):
        open_recording(path, width=WIDTH, height=240)
    told = open_recording(path, columns="t,y,x,p", width=WIDTH, height=240)
    assert same(told.read(), s) and not told.notes


def test_pickles_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "e.npy", np.array([{"t": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="Python objects"):
        open_recording(tmp_path / "e.npy")


def test_gzipped_archive_is_refused_in_one_sentence(tmp_path: Path) -> None:
    np.save(tmp_path / "e.npy", np.zeros((2, 4)))
    packed = tmp_path / "e.npy.gz"
    packed.write_bytes(gzip.compress((tmp_path / "e.npy").read_bytes()))
    with pytest.raises(DataError, match="a gzipped npz file; gunzip it first"):
        open_recording(packed)


def test_event_beside_the_sensor_is_an_error_or_left_out(tmp_path: Path) -> None:
    s = random_stream(6, 300)
    x = s.x.copy()
    x[7] = WIDTH + 5
    np.savez(tmp_path / "e.npz", t=s.t, x=x, y=s.y, p=s.p)
    with pytest.raises(DataError, match=f"event 7 is at x={WIDTH + 5}.*1 such"):
        read_events(tmp_path / "e.npz", width=WIDTH, height=240)
    recording = open_recording(tmp_path / "e.npz", width=WIDTH, height=240, repair=True)
    keep = np.arange(300) != 7
    assert same(recording.read(), EventStream(s.t[keep], s.x[keep], s.y[keep], s.p[keep]))
    assert recording.notes == ["repaired: leaves out events beside the sensor (1)"]


@pytest.mark.parametrize("size", [np.nan, np.inf, -3, 0, "wide", 1 << 20])
def test_a_size_that_no_sensor_has_is_told(tmp_path: Path, size: float | str) -> None:
    s = random_stream(5, 20)
    np.savez(tmp_path / "e.npz", t=s.t, x=s.x, y=s.y, p=s.p, width=size, height=240)
    with pytest.raises(DataError, match="e.npz: width is .*, expected a side of the sensor"):
        open_recording(tmp_path / "e.npz")


@pytest.mark.parametrize("columns", [("t", "x", "p"), ("t", "x", "xy"), ("-", "-", "-")])
def test_columns_without_all_of_t_x_and_y_are_told(
    tmp_path: Path, columns: tuple[str, ...]
) -> None:
    np.save(tmp_path / "e.npy", np.arange(15).reshape(5, 3))
    with pytest.raises(DataError, match=f"--columns is {','.join(columns)}, expected t, x, y"):
        open_recording(tmp_path / "e.npy", columns=columns)
