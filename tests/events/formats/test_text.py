"""Text tables: headers, orders, units, MMHPSD's five columns."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, read_events

from .helpers import HEIGHT, WIDTH, random_stream, same


def _lines(*columns: np.ndarray, sep: str = " ", form: str = "d") -> str:
    rows = zip(*columns, strict=True)
    return "".join(
        sep.join([format(row[0], form), *(str(int(v)) for v in row[1:])]) + "\n" for row in rows
    )


def test_headers_orders_and_units_give_the_same_events(tmp_path: Path) -> None:
    s = random_stream(1, 3_000, first_us=17)
    on = s.p > 0
    texts = {
        "t,x@320,y@240,on\n" + _lines(s.t, s.x, s.y, on, sep=","): (320, 240),
        "# t x y p\n" + _lines(s.t, s.x, s.y, s.p): (None, None),
        f"{WIDTH} {HEIGHT}\n" + _lines(s.t * 1e-6, s.x, s.y, on, form=".6f"): (WIDTH, HEIGHT),
        _lines(s.t * 1e-6, s.x, s.y, on, form=".9f"): (None, None),
        "x;y;polarity;timestamp\n" + _lines(s.x, s.y, on, s.t, sep=";"): (None, None),
        _lines(s.x, s.y, s.t, s.p, sep="\t"): (None, None),
    }
    for number, (text, size) in enumerate(texts.items()):
        path = tmp_path / f"{number}.txt"
        path.write_text(text)
        recording = open_recording(path)
        assert (recording.width, recording.height) == size
        assert same(recording.read(), s), text[:40]
        packed = tmp_path / f"{number}.csv.gz"
        packed.write_bytes(gzip.compress(text.encode("utf-8-sig")))  # as Windows writes texts
        assert same(read_events(packed), s)


@pytest.mark.parametrize("header", [",t,x,y,p\n", ",timestamp,x,y,polarity\n"])
def test_the_numbers_of_rows_that_pandas_writes_are_passed_over(
    tmp_path: Path, header: str
) -> None:
    """Without a name for the first column, five columns were read as MMHPSD's."""
    s = random_stream(6, 300)
    path = tmp_path / "e.csv"
    path.write_text(header + _lines(np.arange(len(s)), s.t, s.x, s.y, s.p, sep=","))
    assert same(read_events(path), s)


@pytest.mark.parametrize("zero", ["0", "0.0"])
def test_seconds_that_are_whole_at_first_are_not_taken_for_microseconds_silently(
    tmp_path: Path, zero: str
) -> None:
    """As of a simulator that begins with thousands of events at once."""
    s = random_stream(7, 2_500, gap_us=700)
    path = tmp_path / "e.txt"
    t = np.concatenate([np.zeros(2_500, np.int64), s.t])
    times = [zero] * 2_500 + [f"{value:.6f}" for value in s.t * 1e-6]
    rows = zip(times, *(np.tile(v, 2).tolist() for v in (s.x, s.y, s.p)), strict=True)
    path.write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    recording = open_recording(path)
    recording.read()
    assert "5,000 events come within 1 us, more than any sensor sends" in recording.notes[-1]
    told = open_recording(path, time_unit="s")
    assert np.array_equal(told.read().t, t) and "sensor sends" not in told.notes[-1]


def test_another_size_of_mmhpsds_columns_is_refused(tmp_path: Path) -> None:
    """Told 1280x800, the sensor before it was turned, most rows lay beside it."""
    path = tmp_path / "event0000.csv"
    path.write_text("0,0,10,3,0\n1279,799,20,3,0\n5,7,20,3,0\n")
    for columns in (None, "mmhpsd"):
        with pytest.raises(DataError, match="800x1280 pixels, found 1280x800 given; leave out"):
            open_recording(path, columns=columns, width=1280, height=800)
        assert open_recording(path, columns=columns, width=800, height=1280).width == 800


def test_mmhpsd_rows_are_turned_by_180_degrees_and_carry_no_polarity(tmp_path: Path) -> None:
    path = tmp_path / "event0000.csv"
    path.write_text("0,0,10,3,0\n1279,799,20,3,0\n5,7,20,3,0\n")
    recording = open_recording(path)
    assert (recording.width, recording.height) == (800, 1280)
    assert not recording.has_polarity
    s = recording.read()
    assert list(zip(s.t, s.x, s.y, s.p, strict=True)) == [
        (10, 799, 1279, 0),
        (20, 0, 0, 0),
        (20, 792, 1274, 0),
    ]


def test_polarity_that_comes_late_is_still_a_polarity(tmp_path: Path) -> None:
    rows = ["t x y p\n", *(f"{i} 1 2 0\n" for i in range(3000)), "3000 1 2 1\n"]
    (tmp_path / "e.txt").write_text("".join(rows))
    s = read_events(tmp_path / "e.txt")
    assert np.array_equal(np.unique(s.p, return_counts=True), [[-1, 1], [3000, 1]])


def test_named_columns_and_units(tmp_path: Path) -> None:
    (tmp_path / "e.txt").write_text("3 9 1 7 12.5\n4 8 1 7 13\n")
    s = read_events(tmp_path / "e.txt", columns="x,y,p,-,t", time_unit="ms")
    assert same(
        s,
        EventStream(
            np.array([12_500, 13_000]),
            np.array([3, 4], dtype=np.uint16),
            np.array([9, 8], dtype=np.uint16),
            np.array([1, 1], dtype=np.int8),
        ),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty|not a recording|holds no events"),
        ("\0\0\0 ftypisom", "a video, which 'evsplat import video' reads"),
        ("hello world\n", "holds no events"),
        ("t,x,y,on\n1,2,3,1\n2,3,4\n3,4,5,1\n", "event 1 at byte 17 has another number"),
        ("t x y p\n1 2 3 1\n2 3 4 x\n", "event 1 at byte 16 is not made of numbers"),
        ("5 9 8 1\n4 8 7 1\n", "4 columns are of no known order"),
        ("t x y p\n5 2 3 1\n4 2 3 1\n", "event 1 is at 4 us, after one at 5 us"),
        (
            "t x y p\n5 2.5 3 1\n",
            "event 0 at byte 8 has a fraction where a whole number is expected",
        ),
        ("t x y p\n5 2 3 7\n", "polarity of event 0 is 7"),
        ("t x y p\n1 2 3 1\nnan 2 3 1\n", "event 1 at byte 16 is not made of numbers"),
    ],
)
def test_bad_text_is_a_data_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "e.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        read_events(tmp_path / "e.txt")


def test_a_remark_below_the_names_of_columns_names_none(tmp_path: Path) -> None:
    s = random_stream(6, 50)
    path = tmp_path / "e.txt"
    path.write_text("# y x t p\n# recorded by Jane Doe\n" + _lines(s.y, s.x, s.t, s.p))
    assert same(read_events(path), s)


def test_a_first_line_of_two_numbers_that_are_no_size_is_told(tmp_path: Path) -> None:
    path = tmp_path / "e.txt"
    path.write_text("1e999 240\n" + "1 2 3 1\n" * 5)
    with pytest.raises(DataError, match="its first line is '1e999 240', expected width and height"):
        open_recording(path)
