"""Frames that are measured: those held out, or those that training saw; their names and words."""

from dataclasses import dataclass
from typing import Any

from evsplat.errors import ConfigError
from evsplat.options.runs import Split
from evsplat.wording import counted


@dataclass(frozen=True)
class SplitWords:
    """How tables and pages speak of the frames of a split."""

    frame: str
    """One of them."""
    title: str
    headline: str
    """Where a figure of the full frame was reached."""
    blurry_input: str
    """Title of the row of the camera's own pictures."""


WORDS: dict[Split, SplitWords] = {
    "test": SplitWords(
        "held-out frame",
        "Test frames",
        "on held-out frames",
        "blurry input itself (no method sees it)",
    ),
    "train": SplitWords(
        "training frame",
        "Training frames",
        "on training frames",
        "blurry input itself (training saw it)",
    ),
}


def check_split(split: str) -> None:
    """A `ConfigError` for any other word, as of a caller in Python, whose words nobody checks."""
    if split not in WORDS:
        raise ConfigError(f"--split {split}: expected {' or '.join(WORDS)}.")


def split_of(metrics: dict[str, Any]) -> Split:
    """The split that figures are of; those without a word on it are of test frames."""
    return "train" if metrics.get("split") == "train" else "test"


def words_of(metrics: dict[str, Any]) -> SplitWords:
    """The words for the frames that were measured."""
    return WORDS[split_of(metrics)]


def count_of(metrics: dict[str, Any]) -> int:
    """The number of frames that were measured."""
    count: int = metrics["frames"][split_of(metrics)]
    return count


def counted_frames(metrics: dict[str, Any]) -> str:
    """So many frames were measured, such as "9 held-out frames"."""
    return counted(count_of(metrics), words_of(metrics).frame)


def name_of(stem: str, split: Split, suffix: str) -> str:
    """Name of a file about one split: metrics.json of test frames, else metrics_train.json."""
    return f"{stem}{suffix}" if split == "test" else f"{stem}_{split}{suffix}"
