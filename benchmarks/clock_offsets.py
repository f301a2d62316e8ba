"""How often the offset of two clocks is found, how exactly, and how often one is found wrongly.

    python benchmarks/clock_offsets.py [--count N] [--width PX] [--frames N] [--seed S]
        [--out FOLDER]

Stages captures at random as `evsplat bench grid` does. The clock of each one's events is moved by
up to a minute either way, and the offset is searched for with all frames and events, with a part of
the frames (35 to 100 %), with a part of the events (50 to 100 %), and with the events of all
captures in a row, its own somewhere among them. At last the events of another capture, which have
no offset, are given. Staged captures stay in the folder. The last line is one JSON object.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import evsplat as ev
from evsplat.benching.drawn import Draw, drawn_settings
from evsplat.calibration.offset import BlockChanges, OffsetEstimate, estimate_offset
from evsplat.capture import Capture, load_capture
from evsplat.capture.metadata import Frame
from evsplat.events import EventStream

FARTHEST_US = 60_000_000
LEAST_FRAMES = 8
PAUSE_US = 500_000
"""Between the captures of a row."""
PARTS = {"all": (1.0, 1.0), "part of the frames": (0.35, 1.0), "part of the events": (1.0, 0.5)}
"""Least shares of frames and of events."""
IN_A_ROW, ANOTHER = "in a row", "of another capture"


@dataclass(frozen=True)
class Outcome:
    """One search."""

    kind: str
    certain: bool
    error_ms: float | None
    """None of events that have no offset, and where nothing was found."""
    correlation: float
    rival: float


def staged(options: argparse.Namespace) -> list[Capture]:
    """The captures of a draw."""
    draw = Draw(options.seed, options.count, options.frames, options.width)
    found = []
    for name, settings in drawn_settings(draw).items():
        path = options.out / name
        if not path.exists():
            ev.stage(path, replace(settings, novel_views="none"))
        found.append(load_capture(path))
    return found


def part_of(length: int, least: float, rng: np.random.Generator) -> tuple[int, int]:
    """Start and end of a part of random length."""
    kept = round(length * rng.uniform(least, 1.0))
    start = int(rng.integers(length - kept + 1))
    return start, start + kept


def search(capture: Capture, frames: Sequence[Frame], events: EventStream) -> OffsetEstimate | None:
    """The offset of ``events`` among these frames of a capture."""
    changes = BlockChanges(capture.transfer(frames[0]))
    for frame in frames:
        changes.add(capture.image(frame), frame.exposure_us)
    camera = capture.camera(frames[0])
    return estimate_offset(changes, [events], (camera.width, camera.height))


def outcome(kind: str, found: OffsetEstimate | None, true_us: int | None) -> Outcome:
    if found is None:
        return Outcome(kind, False, None, 0.0, 0.0)
    error = None if true_us is None else (found.offset_us - true_us) / 1000
    return Outcome(kind, found.is_certain, error, found.correlation, found.rival)


def in_a_row(captures: Sequence[Capture]) -> tuple[EventStream, list[int]]:
    """Events of all captures one after the other, and what is added to get each one's clock."""
    end_us, streams, offsets = 0, [], []
    for capture in captures:
        events = all_events(capture)
        offsets.append(int(events.t[0]) - end_us)
        streams.append(replace(events, t=events.t - offsets[-1]))
        end_us = int(streams[-1].t[-1]) + PAUSE_US
    return EventStream.joined(streams), offsets


def judged(capture: Capture, rng: np.random.Generator) -> list[Outcome]:
    """The searches in one capture with its own events alone."""
    outcomes = []
    recorded = all_events(capture)
    for kind, (of_frames, of_events) in PARTS.items():
        first, end = part_of(len(capture.frames), of_frames, rng)
        if end - first < LEAST_FRAMES:
            first, end = 0, LEAST_FRAMES
        begin, stop = part_of(int(np.ptp(recorded.t)), of_events, rng)
        events = recorded.between(int(recorded.t[0]) + begin, int(recorded.t[0]) + stop)
        true_us = int(rng.integers(-FARTHEST_US, FARTHEST_US))
        moved = replace(events, t=events.t - true_us)
        outcomes.append(outcome(kind, search(capture, capture.frames[first:end], moved), true_us))
    return outcomes


def all_events(capture: Capture) -> EventStream:
    """Events of a whole capture."""
    assert capture.events is not None
    start, end = capture.events.time_range_us
    return capture.events.between(start, end)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--width", type=int, default=80)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("clock_offsets"))
    options = parser.parse_args()
    captures = staged(options)
    rng, outcomes = np.random.default_rng(options.seed), []
    row, offsets = in_a_row(captures)
    for index, capture in enumerate(captures):
        own = outcome(IN_A_ROW, search(capture, capture.frames, row), offsets[index])
        others = search(capture, capture.frames, all_events(captures[index - 1]))
        for one in (*judged(capture, rng), own, outcome(ANOTHER, others, None)):
            error = "" if one.error_ms is None else f"{one.error_ms:10.1f} ms"
            print(
                f"{capture.name:32s} {one.kind:20s} {'certain' if one.certain else 'unsure':8s}"
                f"{one.correlation:6.2f}{one.rival:6.2f} {error}",
                flush=True,
            )
            outcomes.append(one)
    result: dict[str, dict[str, float]] = {}
    for kind in (*PARTS, IN_A_ROW, ANOTHER):
        tried = [one for one in outcomes if one.kind == kind]
        errors = [abs(one.error_ms) for one in tried if one.certain and one.error_ms is not None]
        result[kind] = {
            "tried": len(tried),
            "certain": sum(one.certain for one in tried),
            "largest_correlation": max(one.correlation for one in tried),
            **({"median_ms": float(np.median(errors)), "most_ms": max(errors)} if errors else {}),
        }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
