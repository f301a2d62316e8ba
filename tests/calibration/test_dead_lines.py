"""Rows and columns that are dead are told from those where nothing moves."""

from pathlib import Path

import numpy as np
import pytest

from evsplat.calibration import dead_lines_text, dead_rows
from evsplat.capture.validate import check_capture
from evsplat.events import EventStream, write_events
from evsplat.inspection.recording import inspect_recording

from ..conftest import write_event_file


def _sweep(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Events per pixel of somebody who moves in a part of the picture, of a sensor without noise.

    Each row of theirs is as busy as those beside it, more or less.
    """
    counts = np.zeros((height, width), np.int64)
    top, left = (int(rng.integers(2, side // 3)) for side in (height, width))
    bottom, right = (int(rng.integers(2 * side // 3, side - 2)) for side in (height, width))
    shape = rng.uniform(20, 60, (bottom - top, 1)) * rng.uniform(0.5, 1, (1, right - left))
    counts[top:bottom, left:right] = rng.poisson(shape)
    return counts


def test_dead_lines_are_found_and_no_others(rng: np.random.Generator) -> None:
    """Nor beside hot pixels, where nothing moves."""
    for seed in rng.integers(1_000_000, size=50):
        rng = np.random.default_rng(seed)
        counts = _sweep(rng, 60, 80)
        hot = rng.integers(0, counts.size, 40)
        counts.reshape(-1)[hot] = rng.integers(20, 20_000, 40)
        assert dead_lines_text(counts) == "", seed
        between = np.flatnonzero((counts > 0).sum(1) > 20)[1:-1]
        row = int(rng.choice(between))
        counts[row] = 0
        assert dead_rows(counts) == [row], seed
        assert dead_lines_text(counts) == f"row {row}"
        assert dead_lines_text(counts.T) == f"column {row}"


def _rows(*parts: tuple[int, int]) -> np.ndarray:
    """Counts of rows of 40 pixels: so many rows, of which so many pixels have events."""
    rows = [np.arange(40) < busy for many, busy in parts for _ in range(many)]
    return 9 * np.array(rows).astype(np.int64)


@pytest.mark.parametrize(
    "counts",
    [
        _rows((40, 0)),
        _rows((9, 0), (20, 40), (11, 0)),
        _rows((18, 40), (5, 0), (17, 40)),
        _rows((20, 40), (1, 0), (19, 5)),
        _rows((20, 12), (1, 0), (19, 12)),
        _rows(*[(1, 40), (2, 0)] * 20),
        _rows((20, 40), (1, 0), (19, 40)) // 9,
    ],
    ids=["none", "border", "two people", "the feet", "small", "coarse sensor", "noise"],
)
def test_lines_without_events_for_other_reasons_are_not_dead(counts: np.ndarray) -> None:
    assert dead_rows(counts) == []


def test_inspect_tells_dead_lines_of_captures_and_recordings(
    rng: np.random.Generator, tiny_capture, tmp_path: Path
) -> None:
    path = tiny_capture(frames=12)
    count, row = 60_000, int(rng.integers(3, 20))
    t = np.sort(rng.integers(0, 440_000, count))
    x, y, p = (rng.integers(0, most, count) for most in (32, 24, 2))
    p[0] = 1
    for kept, told in ((np.full(count, True), False), (y != row, True)):
        write_event_file(path / "events.h5", t[kept], x[kept], y[kept], p[kept])
        findings = check_capture(path, deep=True)[1]
        said = [str(one) for one in findings if f"no event in row {row}, " in str(one)]
        assert len(said) == told and all("events.h5: events/y" in one for one in said)
        assert not any("no event in row" in str(one) for one in check_capture(path, deep=False)[1])
        signs = np.where(p > 0, 1, -1).astype(np.int8)
        columns = (t[kept], x[kept].astype(np.uint16), y[kept].astype(np.uint16), signs[kept])
        write_events(tmp_path / "one.h5", EventStream(*columns))
        summary = inspect_recording(tmp_path / "one.h5", tmp_path / "out").summary
        assert (f"no event in row {row}, beside which there are many" in summary) == told
