"""Events out of order: how far, and whether what is sorted mixes two stretches of a recording."""

from pathlib import Path

import numpy as np
import pytest

from evsplat.events import EventStream, open_recording

from .helpers import random_stream


@pytest.fixture(name="seed")
def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 31))


def _repaired(folder: Path, s: EventStream, t: np.ndarray) -> tuple[EventStream, list[str]]:
    """What is read of a file with the events of ``s`` at other times, and the notes on it."""
    np.savez(folder / "e.npz", t=t, x=s.x, y=s.y, p=s.p)
    recording = open_recording(folder / "e.npz", repair=True)
    read = recording.read()
    assert (np.diff(read.t) >= 0).all()
    return read, recording.notes[1:]


def test_a_clock_that_jumps_back_is_told_with_how_far_when_and_what_that_mixes(
    tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    s = random_stream(seed, 6_000, first_us=10**6)
    at, back_us = int(rng.integers(2_000, 4_000)), int(rng.integers(5_000, 20_000))
    t = s.t.copy()
    t[at:] -= back_us
    latest_us = int(s.t[at - 1])
    by_us = latest_us - int(t[at])
    behind = int((t[at:] < latest_us).sum())
    # As of rows that are read at once; a step back before the jump does not hide it.
    t = t + rng.integers(0, 3, len(t))
    read, (repaired, warning) = _repaired(tmp_path, s, t)
    assert np.array_equal(read.t, np.sort(t))
    assert repaired.startswith("repaired: sorts events that are out of order (")
    words = warning.replace(",", "").split()
    numbers = [int(word) for word in words if word.isdigit()]
    assert warning.startswith("warning: the clock of the events jumps back by ")
    assert np.allclose(numbers[:2], [by_us, latest_us], atol=3)
    assert abs(numbers[2] - behind) <= 5
    deepest = [int(word) for word in repaired.replace(",", "").split() if word.isdigit()]
    assert np.allclose(deepest, numbers[:2])
    assert f"{numbers[0]:,} us at {numbers[1]:,} us" in warning and "cut the file there" in warning


def test_a_jump_over_more_than_what_is_sorted_at_once_is_told_as_well(
    tmp_path: Path, seed: int
) -> None:
    s = random_stream(seed, 900_000, gap_us=3)
    t = np.concatenate([s.t[:500_000], s.t[:400_000]])  # from the beginning once more
    _, notes = _repaired(tmp_path, s, t)
    assert any("leaves out events too late to be sorted in" in note for note in notes)
    (warning,) = (note for note in notes if note.startswith("warning: "))
    assert f"jumps back by {s.t[499_999] - s.t[0]:,} us at {s.t[499_999]:,} us" in warning
    assert "and 400,000 events after that" in warning


@pytest.mark.parametrize("kind", ["late events", "late packets", "delays", "before all others"])
def test_events_that_came_late_are_sorted_without_a_word_on_the_clock(
    tmp_path: Path, seed: int, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    s = random_stream(seed, 20_000)
    order = np.arange(len(s))
    if kind == "late events":
        order = np.argsort(order + 400.5 * (rng.random(len(s)) < 0.01), kind="stable")
    elif kind == "late packets":
        packets = order.reshape(-1, 500)
        packets[10::4], packets[11::4] = packets[11::4].copy(), packets[10::4].copy()
        order = packets.reshape(-1)
    elif kind == "delays":
        order = np.argsort(s.t + rng.integers(0, 30_000, len(s)), kind="stable")
    else:
        order = np.roll(order, 7_000)
    t = s.t[order]
    read, notes = _repaired(tmp_path, s, t)
    assert np.array_equal(read.t, s.t)
    (note,) = notes
    depth = np.maximum.accumulate(t) - t
    latest_us = np.maximum.accumulate(t)[depth.argmax()]
    falls = int((np.diff(t) < 0).sum())
    assert note == (
        f"repaired: sorts events that are out of order ({falls:,}), by {depth.max():,} us at most, "
        f"after {latest_us:,} us"
    )


@pytest.mark.parametrize(("top", "bottom"), [(1 << 32, 0), (1 << 31, -(1 << 31)), (1 << 31, 0)])
@pytest.mark.parametrize("count", [400, 200_000])
def test_events_that_come_late_where_a_counter_begins_again_count_one_period(
    tmp_path: Path, seed: int, top: int, bottom: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    s = random_stream(seed, count, gap_us=2)
    t = s.t - s.t[count // 2]  # 0 is where the counter begins again
    order = np.argsort(t + rng.integers(0, 40, count), kind="stable")  # packets that come late
    counter = np.where(t < 0, top + t, bottom + t)[order]
    read, notes = _repaired(tmp_path, s, counter)
    assert np.array_equal(read.t, top + t)
    assert "repaired: adds up the periods of a counter that began again (1)" in notes
    assert not any(note.startswith("warning: no event comes") for note in notes)
