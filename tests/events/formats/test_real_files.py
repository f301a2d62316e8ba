"""Recordings of real cameras: what the files' description says is what is read."""

from pathlib import Path

import numpy as np
import pytest

from evsplat.events import open_recording, read_events

from .helpers import same

# file, format, size, events, duration in seconds
REAL = [
    ("davis346.aedat4", "aedat4", (346, 260), 78_830, 2.36),
    ("person_dvxplorer.aedat4", "aedat4", (320, 240), 323_963, 1.46),
    ("evt2.raw", "raw", (None, None), 521_252, 0.096),
    ("evt3.raw", "raw", (1280, 720), 1_218_618, 10.77),
    ("dvs.es", "es", (320, 240), 473_225, 1.0),
    ("IMU_translBoxes.aedat", "aedat2", (240, 180), 162_771, 2.07),
    ("test_events_1.bag", "rosbag", (640, 480), 343_474, 2.08),
    ("dvs.csv.gz", "csv", (320, 240), 473_225, 1.0),
]


@pytest.mark.parametrize(("name", "kind", "size", "count", "seconds"), REAL)
def test_real_recording_is_what_its_description_says(
    recordings_root: Path,
    name: str,
    kind: str,
    size: tuple[int | None, int | None],
    count: int,
    seconds: float,
) -> None:
    recording = open_recording(recordings_root / name)
    assert recording.format == kind
    assert (recording.width, recording.height) == size
    stream = recording.read()
    assert len(stream) == count
    assert (stream.t[-1] - stream.t[0]) * 1e-6 == pytest.approx(seconds, abs=0.006)
    assert (np.diff(stream.t) >= 0).all()
    width, height = (n or least for n, least in zip(size, (640, 480), strict=True))
    # recordings of this length reach the edges of their sensor
    assert (stream.x.max(), stream.y.max()) == (width - 1, height - 1)
    # a real scene makes both polarities, neither by far the more often
    assert 0.3 < (stream.p > 0).mean() < 0.7


def test_two_files_of_one_recording_agree(recordings_root: Path) -> None:
    """dvs.es and dvs.csv were written from the same events by other software."""
    a, b = (read_events(recordings_root / name) for name in ("dvs.es", "dvs.csv.gz"))
    assert same(a, b)


def test_frames_lie_40_ms_apart_with_half_a_millisecond_of_exposure(recordings_root: Path) -> None:
    recording = open_recording(recordings_root / "davis346.aedat4")
    frames = list(recording.frames())
    events = recording.read()
    starts, ends = np.array([frame.exposure_us for frame in frames]).T
    assert len(frames) == 59
    assert all(frame.image.shape == (260, 346) for frame in frames)
    assert np.array_equal(ends - starts, np.full(59, 500))
    assert np.abs(np.diff(starts) - 40_000).max() < 100
    assert abs(starts[0] - events.t[0]) < 10_000 and abs(ends[-1] - events.t[-1]) < 50_000
    # neighbouring pixels of a picture resemble each other, those of a picture read askew do not
    image = frames[0].image.astype(float)
    assert np.corrcoef(image[1:].ravel(), image[:-1].ravel())[0, 1] > 0.8
