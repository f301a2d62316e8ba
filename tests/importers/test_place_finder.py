"""``--homography auto``: events of another sensor are brought into the pictures, or refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evsplat.calibration.ways import WAYS
from evsplat.capture import Capture, load_capture
from evsplat.cli import main
from evsplat.events import EventStream, moved, read_homography, write_events
from evsplat.importers import import_capture

from ..calibration.film import (
    HEIGHT,
    WIDTH,
    Film,
    drawn_film,
    drawn_place,
    recorded_by,
    turned_sensor,
)


def written(folder: Path, film: Film, events: EventStream | None, size: tuple[int, int]) -> Path:
    (folder / "images").mkdir(parents=True)
    for index, picture in enumerate(film.pictures):
        coded = np.clip(picture * 255 + 0.5, 0, 255).astype(np.uint8)
        Image.fromarray(coded).save(folder / "images" / f"{index:04d}.png")
    np.savetxt(folder / "exposures.txt", film.spans_us, fmt="%d")
    if events is not None:
        write_events(folder / "events.h5", events, width=size[0], height=size[1])
    return folder


def all_events(capture: Capture) -> EventStream:
    assert capture.events is not None
    return capture.events.between(-(1 << 40), 1 << 40)


def test_what_is_found_is_in_the_capture_and_can_be_given_back(
    tmp_path: Path, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    """Mirrored, turned or neither, on a clock that knows nothing of that of the pictures."""
    film, offset = drawn_film(rng), int(rng.integers(-(10**9), 10**9))
    matrix, size = turned_sensor(*drawn_place(rng), str(rng.choice(list(WAYS))))
    events = recorded_by(film.events, matrix, size, rng)
    late = replace(events, t=events.t - offset)
    source = written(tmp_path / "rec", film, late, size)
    with caplog.at_level("INFO"):
        out = import_capture(
            "folder", source, tmp_path / "out", homography="auto", clock_offset_us="auto"
        )
    file = out / "events_to_pictures.txt"
    assert "found where they lie over the pictures" in caplog.text and file.name in caplog.text
    found, capture = read_homography(file), load_capture(out)
    kept = capture.provenance["homography"]
    assert np.array_equal(kept["matrix"], found) and kept["file"] == file.name
    assert kept["sensor"] == list(size) and kept["correlation"] > 0.5 > kept["error_px"]
    points = np.stack([film.events.x, film.events.y, np.ones(len(film.events))])
    back = found @ matrix @ points
    off = np.hypot(*(back[:2] / back[2] - points[:2]))
    assert np.quantile(off, 0.9) < 0.7 * max(1, WIDTH / max(size))
    assert capture.clock_offset_us == pytest.approx(offset, abs=12_000)
    given = import_capture(
        "folder", source, tmp_path / "given", homography=file,
        clock_offset_us=capture.clock_offset_us,
    )  # fmt: skip
    by_file, by_search = all_events(load_capture(given)), all_events(capture)
    brought = EventStream.joined(list(moved([late], found, WIDTH, HEIGHT)))
    assert len(by_search) == len(by_file) == len(brought)
    for column in "xyp":
        assert np.array_equal(getattr(by_file, column), getattr(by_search, column))
        assert np.array_equal(getattr(brought, column), getattr(by_search, column))


def test_where_nothing_is_certain_nothing_is_written(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    film = drawn_film(rng)
    still = replace(film, pictures=film.pictures[:1] * len(film.pictures))
    matrix, size = drawn_place(rng)
    events = recorded_by(film.events, matrix, size, rng)
    order = rng.permutation(len(events))
    shuffled = replace(events, x=events.x[order], y=events.y[order])
    for name, recording, said in (
        ("still", written(tmp_path / "still", still, events, size), "hardly anything changes"),
        ("other", written(tmp_path / "other", film, shuffled, size), "its events (agree|tell)"),
        (
            "inverted",
            written(tmp_path / "inverted", film, replace(events, p=-events.p), size),
            "only if they were of the other polarity .* convert .* --invert",
        ),
        ("none", written(tmp_path / "none", film, None, size), "there are no events; give"),
    ):
        out = tmp_path / f"{name}_out"
        asked = ["import", "folder", str(recording), "--out", str(out), "--homography", "auto"]
        assert main(asked) == 2
        error = capsys.readouterr().err
        assert re.search(said, error, re.DOTALL) and "Traceback" not in error
        assert ("cv2.findHomography" in error) == (name in ("still", "other"))
        assert not out.exists()
