"""`evsplat inspect` of bare recordings, and the clock's warning for captures."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evsplat.errors import DataError
from evsplat.inspection import (
    inspect,
    inspect_capture,
    inspect_recording,
    warn_of_capture,
)

Factory = Callable[..., Path]


def _save(path: Path, *, seconds: float = 2.0, brighter: float = 0.75, seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    count = 4_000
    t = np.sort(rng.integers(0, int(seconds * 1e6), count))
    t[0], t[-1] = 0, int(seconds * 1e6) - 1
    p = np.zeros(count, dtype=np.int8)
    p[: int(brighter * count)] = 1
    x, y = rng.integers(0, 40, count), rng.integers(0, 30, count)
    x[0], y[0] = 39, 29
    np.savez(path, t=t, x=x.astype(np.uint16), y=y.astype(np.uint16), p=rng.permutation(p))
    return path


@pytest.mark.parametrize("seed", [0, 1])
def test_counts_rate_size_and_polarity_are_right(tmp_path: Path, seed: int) -> None:
    report = inspect_recording(_save(tmp_path / "events.npz", seed=seed), tmp_path / "out")
    assert report.usable
    for words in ("npz, sensor 40x30", "4,000 over 2.000 s (2k/s", "75.0 % brighter"):
        assert words in report.summary
    assert "clock" not in report.summary and "frames" not in report.summary
    assert [picture.name for picture in report.pictures] == ["events.png", "rate.png"]
    for picture in report.pictures:
        with Image.open(picture) as image:
            assert len(np.unique(np.asarray(image.convert("L")))) > 30


@pytest.mark.parametrize("seconds", [0.002, 0.005, 0.01, 0.03])
def test_the_highest_rate_is_no_less_than_the_mean(tmp_path: Path, seconds: float) -> None:
    summary = inspect_recording(
        _save(tmp_path / "events.npz", seconds=seconds), tmp_path / "out"
    ).summary
    said = re.search(r"s \((\S+?)([kM])/s, at most (\S+?)([kM])/s\)", summary)
    assert said is not None
    factor = {"k": 1e3, "M": 1e6}
    mean, most = (float(said[at]) * factor[said[at + 1]] for at in (1, 3))
    assert mean == pytest.approx(4_000 / seconds, rel=0.01)
    assert mean <= most < (1.2 if seconds > 0.01 else 1.001) * mean


def test_a_long_recording_is_summed_up_but_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evsplat.inspection.recording.MOST_EVENTS", 1)
    report = inspect_recording(_save(tmp_path / "events.npz"), tmp_path / "out")
    assert "4,000 over 2.000 s" in report.summary


def test_files_are_recordings_and_folders_are_captures(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture()
    assert "train" in inspect(path, tmp_path / "one").summary
    assert "sensor" in inspect(_save(tmp_path / "events.npz"), tmp_path / "two").summary
    nothing = inspect(tmp_path / "nothing", tmp_path / "three")
    assert not nothing.usable and not (tmp_path / "three").exists()


def test_what_is_no_recording_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "notes.bin").write_bytes(b"\x00\x01 not events")
    with pytest.raises(DataError, match="notes.bin"):
        inspect(tmp_path / "notes.bin", tmp_path / "out")
    np.savez(tmp_path / "none.npz", **{key: np.zeros(0, dtype=np.uint16) for key in "txyp"})
    with pytest.raises(DataError, match="no events"):
        inspect_recording(tmp_path / "none.npz", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_wrong_clock_offset_is_a_warning_that_says_what_to_try(
    tiny_capture: Factory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tiny_capture(frames=20, width=96, height=72)
    assert inspect_capture(path, tmp_path / "right").findings == ()
    warn_of_capture(path)
    assert not any("clock" in record.getMessage() for record in caplog.records)
    document = json.loads((path / "capture.json").read_text())
    document["events"]["clock_offset_us"] = 9_000
    (path / "capture.json").write_text(json.dumps(document))
    report = inspect_capture(path, tmp_path / "wrong")
    (finding,) = report.findings
    assert report.usable and finding.field == "events.clock_offset_us"
    assert "lag the frames" in finding.found
    tried = re.fullmatch(
        r"Write (-?\d+) there, or import again with --clock-offset-us (-?\d+)\.", finding.remedy
    )
    assert tried is not None and tried[1] == tried[2] and abs(int(tried[1])) < 3_000
    assert f"warning: {finding}" in report.summary
    warn_of_capture(path)  # as an import does, from training frames alone
    assert any("found 9000, with which events lag" in r.getMessage() for r in caplog.records)


def test_the_davis_recording_is_read_with_its_frames(recordings_root: Path, tmp_path: Path) -> None:
    report = inspect(recordings_root / "davis346.aedat4", tmp_path)
    for words in (
        "aedat4, sensor 346x260",
        "78,830 over 2.360 s",
        "59: 346x260, 25 frames/s, exposure 0.5 ms",
        "events lag the frames by 5.",
        "ms from part to part, and up to 5.5 too late if all that moves is slow; correlation 0.9",
        "would align them",
    ):
        assert words in report.summary
    (fitted,) = re.findall(r"C\+ (0\.\d+), C- (0\.\d+) fitted", report.summary)
    assert [float(one) for one in fitted] == pytest.approx([0.36, 0.40], rel=0.1)
    names = [picture.name for picture in report.pictures]
    assert names == ["events.png", "rate.png", "clock.png"]
