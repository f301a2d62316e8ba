"""Events are moved to the pixels that a homography says, and bad ones are told in a sentence."""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from evsplat.cli import main
from evsplat.errors import ConfigError
from evsplat.events import (
    EventStream,
    moved,
    open_recording,
    read_events,
    read_homography,
    write_events,
)
from evsplat.events.homography import write_homography

from .formats.helpers import HEIGHT, WIDTH, random_stream, same


@pytest.fixture(params=range(3))
def rng(rng: np.random.Generator) -> np.random.Generator:
    """Three draws."""
    return rng


def drawn(rng: np.random.Generator, count: int = 4_000) -> EventStream:
    return random_stream(int(rng.integers(1_000_000)), count)


def projective(rng: np.random.Generator) -> np.ndarray:
    """From a sensor of WIDTH x HEIGHT into pictures of about twice the size, with perspective."""
    H = np.array([[2.0, 0.02, -12.0], [-0.03, 2.1, -9.0], [1e-4, -2e-4, 1.0]])
    H[:2] += rng.normal(0, 0.02, (2, 3))
    H[2, :2] += rng.normal(0, 5e-5, 2)
    return H


def joined(s: EventStream, H: np.ndarray, width: int, height: int) -> EventStream:
    return EventStream.joined(list(moved([s], H, width, height)))


def test_a_shift_moves_all_by_as_much_and_leaves_out_what_falls_outside(
    rng: np.random.Generator,
) -> None:
    s = drawn(rng)
    right, down = rng.integers(-40, 40, 2).tolist()
    H = np.array([[1.0, 0, right], [0, 1, down], [0, 0, 1]])
    x, y = s.x.astype(int) + right, s.y.astype(int) + down
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    expected = EventStream(s.t, x.astype(np.uint16), y.astype(np.uint16), s.p).take(inside)
    assert same(joined(s, H, WIDTH, HEIGHT), expected)
    again = joined(joined(s, H, 500, 400), np.linalg.inv(H), WIDTH, HEIGHT)
    assert same(again, s.take((x >= 0) & (y >= 0)))


def test_a_scale_is_about_the_centre_of_the_first_pixel(rng: np.random.Generator) -> None:
    s = drawn(rng)
    found = joined(s, np.diag([3.0, 2.0, 1.0]), 3 * WIDTH, 2 * HEIGHT)
    assert same(found, EventStream(s.t, 3 * s.x, 2 * s.y, s.p))
    # the same map, whatever all nine are multiplied by
    assert same(joined(s, np.diag([-1.5, -1.0, -0.5]), 3 * WIDTH, 2 * HEIGHT), found)


def test_perspective_is_opencvs_and_pieces_do_not_matter(rng: np.random.Generator) -> None:
    s, H, width, height = drawn(rng), projective(rng), 580, 440
    there = cv2.perspectiveTransform(np.stack([s.x, s.y], -1)[None].astype(float), H)[0]
    seen = ((there > -0.5) & (there < (width - 0.5, height - 0.5))).all(-1)
    assert 0.1 < seen.mean() < 1
    found = joined(s, H, width, height)
    assert np.array_equal(found.t, s.t[seen]) and np.array_equal(found.p, s.p[seen])
    assert np.abs(np.stack([found.x, found.y], -1) - there[seen]).max() < 0.5001
    cuts = [0, *np.sort(rng.integers(0, len(s), 9)).tolist(), len(s)]
    pieces = [s.take(slice(a, b)) for a, b in zip(cuts, cuts[1:], strict=False)]
    parts = list(moved(pieces, H, width, height))
    assert all(len(part) for part in parts) and same(EventStream.joined(parts), found)


def test_pieces_are_moved_as_they_are_asked_for() -> None:
    read: list[int] = []

    def pieces() -> Iterator[EventStream]:
        for number in range(5):
            read.append(number)
            yield random_stream(number, 10)

    going = moved(pieces(), np.eye(3), WIDTH, HEIGHT)
    assert read == []
    next(going)
    assert read == [0]


def test_what_is_infinitely_far_is_outside() -> None:
    """Columns 0 to 9, of which the fifth is where the third row of the matrix is 0."""
    x = np.arange(10, dtype=np.uint16)
    s = EventStream(x.astype(np.int64), x, np.zeros_like(x), np.ones(10, np.int8))
    H = np.array([[0.0, 0, 20], [0, 1, 0], [1, 0, -5]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = joined(s, H, 100, 100)
    assert found.t.tolist() == [6, 7, 8, 9] and found.x.tolist() == [20, 10, 7, 5]


def test_a_homography_is_read_as_it_was_written(tmp_path: Path, rng: np.random.Generator) -> None:
    H = projective(rng) * rng.choice([-1.0, 1e-5, 1e5])
    np.savetxt(tmp_path / "saved.txt", H)
    np.save(tmp_path / "saved.npy", H)
    write_homography(tmp_path / "own.txt", H, (580, 440))
    for path in tmp_path.iterdir():
        assert np.array_equal(read_homography(path), H)
    assert "580x440" in (tmp_path / "own.txt").read_text()


def test_the_command_moves_events_and_says_how_many_fell_outside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rng: np.random.Generator
) -> None:
    s, H = drawn(rng), projective(rng)
    np.savetxt(tmp_path / "H.txt", H)
    files = {"said.raw": (WIDTH, HEIGHT), "unsaid.csv": (None, None)}
    for name, (width, height) in files.items():
        source, out = tmp_path / name, tmp_path / f"{name}.h5"
        write_events(source, s, width=width, height=height)
        homography = ["--homography", str(tmp_path / "H.txt"), "--size", "580", "440"]
        assert main(["convert", str(source), str(out), *homography, "--from-zero"]) == 0
        recording, expected = open_recording(out), joined(s, H, 580, 440)
        assert (recording.width, recording.height) == (580, 440)
        found = recording.read()
        assert same(found, EventStream(expected.t - expected.t[0], *_places(expected)))
        printed = capsys.readouterr().out
        share = (len(s) - len(expected)) / len(s)
        assert f"{len(expected):,} events" in printed and "580 x 440 pixels" in printed
        assert f"into 580x440 pixels by H.txt; {share:.1%} of them fell outside" in printed
        assert "--width" not in printed, "nobody needs the size of the sensor"


def _places(s: EventStream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return s.x, s.y, s.p


BAD = {
    "missing": (None, "H.txt: file not found"),
    "rows": ("1 0 0\n0 1 0\n", "found 2 x 3 numbers, expected 3 lines of 3 numbers"),
    "too many": ("1 0 0\n0 1 0\n0 0 1\n" * 9, "found 4 x 3 numbers"),
    "nothing": ("\n", "found no numbers"),
    "words": ("1 0 0\n0 one 0\n0 0 1\n", "found something else .*'one'"),
    "endless": ("1 0 0\n0 inf 0\n0 0 1\n", "found numbers that are not finite"),
    "singular": ("1 2 3\n2 4 6\n0 0 1\n", "found a singular matrix"),
    "zero": ("0 0 0\n0 0 0\n0 0 0\n", "found a singular matrix"),
    "outside": ("1 0 9e3\n0 1 0\n0 0 1\n", "in.npz: by .*H.txt all of its events fall outside"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_one_sentence_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    text, said = BAD[what]
    source, file = tmp_path / "in.npz", tmp_path / "H.txt"
    write_events(source, random_stream(1, 100))
    if text is not None:
        file.write_text(text)
    before = sorted(tmp_path.iterdir())
    asked = ["convert", str(source), str(tmp_path / "out.h5"), "--homography", str(file)]
    assert main([*asked, "--size", "320", "240"]) == 2
    error = capsys.readouterr().err
    assert re.search(said, error) and "Traceback" not in error
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.array([object()]), "holds Python objects"),
        (np.full((3, 3), "1"), "found an array of <U1"),
        (np.eye(3)[None], "found 1 x 3 x 3 numbers"),
    ],
)
def test_a_npy_of_something_else_is_refused(
    tmp_path: Path, array: np.ndarray, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "H.npy", array)
    write_events(tmp_path / "in.npz", random_stream(1, 100))
    asked = ["convert", str(tmp_path / "in.npz"), str(tmp_path / "out.h5")]
    assert main([*asked, "--homography", str(tmp_path / "H.npy"), "--size", "9", "9"]) == 2
    assert said in capsys.readouterr().err


def test_the_size_belongs_to_the_homography(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_events(tmp_path / "in.npz", random_stream(1, 100))
    np.savetxt(tmp_path / "H.txt", np.eye(3))
    asked = ["convert", str(tmp_path / "in.npz"), str(tmp_path / "out.h5")]
    homography = ["--homography", str(tmp_path / "H.txt")]
    for options, said in (
        (homography, "give --size WIDTH HEIGHT"),
        (["--homography", "auto"], "is found by pictures, of which convert has none"),
        (["--size", "320", "240"], "--size: belongs to --homography"),
        ([*homography, "--size", "0", "240"], "--size 0 240: expected pixels from 1 to 65536"),
    ):
        assert main([*asked, *options]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out.h5").exists()
    with pytest.raises(ConfigError, match="homography: found 2 x 2 numbers, expected 3 lines"):
        moved([], np.eye(2), 320, 240)


def test_an_empty_recording_stays_one(tmp_path: Path) -> None:
    write_events(tmp_path / "in.npz", iter(()))
    np.savetxt(tmp_path / "H.txt", np.eye(3))
    homography = ["--homography", str(tmp_path / "H.txt"), "--size", "8", "8"]
    assert main(["convert", str(tmp_path / "in.npz"), str(tmp_path / "out.h5"), *homography]) == 0
    assert len(read_events(tmp_path / "out.h5")) == 0
