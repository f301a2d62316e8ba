"""Event maps of a capture: speed beside eventcv, and how well counts tell the true change.

    python benchmarks/event_maps.py CAPTURE [--milliseconds 80] [--repeats 20]

First the time that each map of a window takes, and the same map in eventcv where it has it, both
from arrays in memory. Then the change of log-brightness between the middles of neighbouring frames
that have sharp pictures: mean error of what events report where the truth changes by more than 0.1,
by counts alone and with what has begun of the next events. The last line is one JSON object.
"""

import argparse
import json
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import eventcv
import numpy as np
import torch

from evsplat.capture import Capture, load_capture
from evsplat.events import (
    EventStream,
    begun_counts,
    polarity_counts,
    time_surface,
    voxel_grid,
)
from evsplat.pictures import log_brightness

REACH_US = 100_000
EPS = 0.004


def best_ms(run: Callable[[], object], repeats: int) -> float:
    """Of several runs, the one that was disturbed least."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1_000 * min(times)


def speed(capture: Capture, milliseconds: int, repeats: int) -> dict[str, float]:
    """Times of each map of the window with the most events, and their ratios."""
    events = capture.events
    assert events is not None
    size = events.height, events.width
    middle = max(
        (frame.mid_us for frame in capture.frames[2:-2]),
        key=lambda mid: len(events.between(mid, mid + 1_000 * milliseconds)),
    )
    stream = events.between(middle, middle + 1_000 * milliseconds)
    rows = np.stack([stream.x, stream.y, stream.t, stream.p > 0], axis=1).astype(np.int64)
    peer = eventcv.from_numpy(rows, sensor_size=size[::-1], time_unit="us")
    wide = events.between(middle - REACH_US, middle + 1_000 * milliseconds + REACH_US)
    times = [middle + 1_000 * milliseconds * step // 7 for step in range(8)]
    maps: dict[str, tuple[Callable[[], object], Callable[[], object] | None]] = {
        "polarity_counts": (lambda: polarity_counts(stream, *size), lambda: peer.count()),
        "voxel_grid_5": (lambda: voxel_grid(stream, *size, 5), lambda: peer.voxel(bins=5)),
        "time_surface": (
            lambda: time_surface(stream, *size, decay_us=3e4),
            lambda: peer.tsurf(tau_ms=30.0),
        ),
        "begun_counts_8_times": (
            lambda: begun_counts(wide, times, *size, reach_us=REACH_US),
            None,
        ),
    }
    print(f"{len(stream)} events of {milliseconds} ms, {len(wide)} within reach of 8 times")
    figures: dict[str, float] = {"events": len(stream), "events_within_reach": len(wide)}
    for name, (ours, theirs) in maps.items():
        figures[f"{name}_best_ms"] = round(best_ms(ours, repeats), 3)
        line = f"  {name:22} {figures[f'{name}_best_ms']:8.2f} ms"
        if theirs is not None:
            other = best_ms(theirs, repeats)
            figures[f"{name}_over_eventcv_ratio"] = round(figures[f"{name}_best_ms"] / other, 3)
            line += f"   eventcv {other:8.2f} ms"
        print(line)
    return figures


def accuracy(capture: Capture) -> dict[str, float]:
    """Mean error of the reported change between neighbouring frames where something moves."""
    events = capture.events
    assert events is not None and capture.contrast_threshold is not None
    on, off = capture.contrast_threshold
    size = events.height, events.width

    def level(counts: torch.Tensor) -> torch.Tensor:
        return on * counts[0] - off * counts[1]

    frames = [(frame, capture.sharp(frame)) for frame in capture.frames]
    logs = [
        (frame.mid_us, log_brightness(sharp, eps=EPS))
        for frame, sharp in frames
        if sharp is not None
    ]
    errors: dict[str, list[float]] = {"complete": [], "begun": []}
    for (start, before), (end, after) in pairwise(logs):
        stream: EventStream = events.between(start - REACH_US, end + REACH_US)
        change = level(polarity_counts(stream.between(start, end), *size))
        first, last = begun_counts(stream, [start, end], *size, reach_us=REACH_US)
        truth = after - before
        moving = truth.abs() > 0.1
        for name, told in (("complete", change), ("begun", change + level(last) - level(first))):
            errors[name] += (told - truth)[moving].abs().tolist()
    means = {f"{name}_mean_error_log": round(float(np.mean(e)), 4) for name, e in errors.items()}
    print(
        f"  change between frames: error {means['complete_mean_error_log']} by counts alone, "
        f"{means['begun_mean_error_log']} with what has begun"
    )
    return means


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--milliseconds", type=int, default=80)
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    capture = load_capture(options.capture)
    figures = speed(capture, options.milliseconds, options.repeats)
    print(json.dumps({**figures, **accuracy(capture)}))


if __name__ == "__main__":
    main()
