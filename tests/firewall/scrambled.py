"""Captures of random splits and exposures, and the same with noise in all that is held out."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hypothesis import strategies as st
from PIL import Image

from ..conftest import write_event_file, write_tiny_capture

FRAMES = 13


@dataclass(frozen=True)
class Recorded:
    """How a capture differs from the tiny one; nothing of it is known to what is tested."""

    held_out: frozenset[int]
    longer_us: int
    """Added to either end of every exposure: beyond 5,000 they overlap."""
    states_thresholds: bool
    has_polarity: bool
    seed: int


def recordings(**fixed: Any) -> st.SearchStrategy[Recorded]:
    """Any split that leaves two runs of frames to train on, at the ends as between them."""
    drawn: dict[str, st.SearchStrategy[Any]] = {
        "held_out": st.frozensets(st.sampled_from([0, 1, 4, 7, 8, 9, 12]), min_size=1, max_size=5),
        "longer_us": st.sampled_from([0, 3_000, 9_000]),
        "states_thresholds": st.booleans(),
        "has_polarity": st.booleans(),
        "seed": st.integers(0, 1_000),
    }
    return st.builds(Recorded, **drawn | {key: st.just(value) for key, value in fixed.items()})


def write_recorded(path: Path, recorded: Recorded) -> Path:
    """The capture as it was recorded."""
    write_tiny_capture(path, frames=FRAMES, seed=recorded.seed)
    document = _document(path)
    for index, frame in enumerate(document["frames"]):
        start, end = frame["exposure_us"]
        frame["exposure_us"] = [start - recorded.longer_us, end + recorded.longer_us]
        frame["split"] = "test" if index in recorded.held_out else "train"
    if not recorded.states_thresholds:
        document["events"]["contrast_threshold"] = None
    (path / "capture.json").write_text(json.dumps(document))
    if not recorded.has_polarity:
        with h5py.File(path / "events.h5", "r+") as file:
            file["events/p"][:] = 0
    shutil.copy(path / "body.npz", path / "body_dense.npz")
    return path


def scrambled(path: Path, target: Path, seed: int, *, has_polarity: bool, masks: bool) -> Path:
    """A copy with noise in place of everything that training may not see.

    ``masks``: those of training frames stay, because they are given.
    """
    shutil.copytree(path, target)
    rng = np.random.default_rng(seed)
    document = _document(target)
    for frame in document["frames"]:
        hidden = ["sharp"] if masks and frame["split"] == "train" else ["sharp", "mask"]
        for kind in (*hidden, *(["image"] if frame["split"] == "test" else [])):
            _noise(target / frame[kind], rng)
    for view in document["novel_views"]:
        _noise(target / view["image"], rng)
    dense = target / "body_dense.npz"
    if dense.exists():
        body = dict(np.load(dense))
        body["poses"] = body["poses"] + rng.normal(size=body["poses"].shape).astype(np.float32)
        np.savez(dense, **body)
    _scramble_events(target / "events.h5", document, rng, has_polarity)
    return target


def hidden(times: np.ndarray, frames: list[dict[str, Any]]) -> np.ndarray:
    """Which times lie between the end of the last training exposure before a held-out frame and
    the start of the next one after it; written anew, one held-out frame at a time.
    """
    found = np.zeros(len(times), dtype=bool)
    middle = {frame["name"]: sum(frame["exposure_us"]) / 2 for frame in frames}
    train = [frame for frame in frames if frame["split"] == "train"]
    for frame in frames:
        if frame["split"] == "train":
            continue
        before = [f["exposure_us"][1] for f in train if middle[f["name"]] < middle[frame["name"]]]
        after = [f["exposure_us"][0] for f in train if middle[f["name"]] > middle[frame["name"]]]
        found |= (times >= max(before, default=-np.inf)) & (times < min(after, default=np.inf))
    return found


def _scramble_events(
    path: Path, document: dict[str, Any], rng: np.random.Generator, has_polarity: bool
) -> None:
    with h5py.File(path) as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    last = max(frame["exposure_us"][1] for frame in document["frames"])
    drawn = rng.integers(0, last + 20_000, 3_000)
    new = np.sort(drawn[hidden(drawn, document["frames"])])
    kept = ~hidden(t, document["frames"])
    columns = [
        np.concatenate([t[kept], new]),
        np.concatenate([x[kept], rng.integers(0, document["events"]["width"], len(new))]),
        np.concatenate([y[kept], rng.integers(0, document["events"]["height"], len(new))]),
        # a sensor that does not tell polarity may seem to where it is not looked at
        np.concatenate([p[kept], rng.integers(0, 2, len(new))]),
    ]
    order = np.argsort(columns[0], kind="stable")
    write_event_file(path, *(column[order] for column in columns))
    assert (
        has_polarity or not columns[3][order][~hidden(columns[0][order], document["frames"])].any()
    )


def _noise(path: Path, rng: np.random.Generator) -> None:
    with Image.open(path) as image:
        shape = np.asarray(image).shape
    Image.fromarray(rng.integers(0, 256, shape, dtype=np.uint8)).save(path)


def _document(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((path / "capture.json").read_text())
    return document
