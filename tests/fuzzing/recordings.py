"""Recordings of one's own, small enough to be imported in milliseconds."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.events import EventStream
from evsplat.pictures.video import write_video

from ..conftest import write_tiny_capture
from ..events.formats.encoders import aedat4

WIDTH, HEIGHT, COUNT = 32, 24, 4
PERIOD_US, EXPOSURE_US = 40_000, 30_000

Source = tuple[str, dict[str, Any], dict[str, str]]
"""What is imported, its options, and those that are files, all below the folder."""


def write_video_recording(root: Path) -> Source:
    """A clip, its events as a table, and the camera."""
    write_video(root / "clip.mp4", [np.repeat(p[..., None], 3, -1) for p in _pictures()], fps=25)
    events = _events()
    rows = np.stack([events.t, events.x, events.y, events.p > 0], axis=1)
    np.savetxt(root / "events.csv", rows, "%d", ",", header="t,x,y,p", comments="")
    _write_camera(root / "camera.json")
    files = {"events": "events.csv", "camera": "camera.json"}
    return "clip.mp4", {"exposure_us": EXPOSURE_US, "start_us": EXPOSURE_US // 2}, files


def write_davis_recording(root: Path) -> Source:
    """Frames and events in one file."""
    starts = range(0, COUNT * PERIOD_US, PERIOD_US)
    frames = [(p, t, t + EXPOSURE_US) for p, t in zip(_pictures(), starts, strict=True)]
    (root / "dance.aedat4").write_bytes(aedat4(_events(), WIDTH, HEIGHT, frames))
    return "dance.aedat4", {}, {}


def write_folder_recording(root: Path) -> Source:
    """Pictures, masks, exposures, a camera, events and a rig that moves."""
    capture = write_tiny_capture(root / "made", frames=COUNT, width=WIDTH, height=HEIGHT)
    document = json.loads((capture / "capture.json").read_text())
    place = root / "mine"
    place.mkdir()
    for part in ("images", "masks", "events.h5", "body.npz"):
        (capture / part).rename(place / part)
    (place / "camera.json").write_text(json.dumps(document["cameras"]["main"]))
    exposures = [frame["exposure_us"] for frame in document["frames"]]
    np.savetxt(place / "exposures.txt", exposures, "%d")
    shutil.rmtree(capture)
    return "mine", {"pose_source": "exact"}, {}


def _pictures() -> list[np.ndarray]:
    pictures = [np.full((HEIGHT, WIDTH), 60, np.uint8) for _ in range(COUNT)]
    for index, picture in enumerate(pictures):
        picture[:, 2 * index : 2 * index + 6] = 200
    return pictures


def _events() -> EventStream:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, COUNT * PERIOD_US, 300)).astype(np.int64)
    x, y = (rng.integers(0, size, 300).astype(np.uint16) for size in (WIDTH, HEIGHT))
    return EventStream(t, x, y, rng.choice([-1, 1], 300).astype(np.int8))


def _write_camera(path: Path) -> None:
    K = [[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]
    lens = {"model": "opencv", "coefficients": [-0.1, 0.01, 0.0, 0.0]}
    path.write_text(json.dumps({"width": WIDTH, "height": HEIGHT, "K": K, "distortion": lens}))
