"""What a large bench costs: the schedule of its cells on a cluster, simulated event by event.

python benchmarks/schedule.py [--captures 1000] [--workers 64] [--from bench/stage] ...

Cells wait in one queue, as on Ray: whenever a worker is free it takes the next. Machines fail at
random (spot instances are taken away); a cell then goes on from its last checkpoint on another
worker, after the time that a start takes. Minutes per cell are those given, or with ``--from`` the
measured ones of a finished bench, row by row. Printed against the lower bound of any schedule, the
work divided by the workers. The last line is JSON with a unit in each key.
"""

import argparse
import heapq
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evsplat.untrusted.text import read_json


@dataclass(frozen=True)
class Cluster:
    """Workers of equal speed; one worker has the cores or the GPU of one cell."""

    workers: int
    mean_hours_to_failure: float | None
    """Of one worker; None: none fails."""
    start_s: float
    """From taking a cell to its first step: process, imports, reading the capture."""
    checkpoint_s: float
    """Time between checkpoints."""
    replace_s: float
    """Until a failed worker is there again."""


@dataclass(frozen=True)
class Outcome:
    """What a simulated bench took."""

    makespan_h: float
    busy_h: float
    """Worker hours spent on cells, starts and lost steps among them."""
    lost_h: float
    """Worker hours of steps that had to be made again."""
    failures: int


def simulate(cells_s: np.ndarray, cluster: Cluster, rng: np.random.Generator) -> Outcome:
    """Give the cells out in order; ``cells_s`` are seconds of work without the start."""
    left = list(cells_s)
    queue = list(range(len(left)))[::-1]
    free = [(0.0, worker) for worker in range(cluster.workers)]
    busy = lost = makespan = 0.0
    failures = 0
    ready = np.zeros(len(left))
    ends: list[tuple[float, int, int, float]] = []
    while queue or ends:
        while queue and free and (not ends or free[0][0] <= ends[0][0]):
            now, worker = heapq.heappop(free)
            cell = queue.pop()
            now = max(now, ready[cell])
            takes = cluster.start_s + left[cell]
            fails = np.inf
            if cluster.mean_hours_to_failure is not None:
                # Without memory: how long the worker has lived says nothing of how long it will.
                fails = rng.exponential(3600 * cluster.mean_hours_to_failure)
            worked = min(takes, fails)
            if fails < takes:
                made = max(0.0, worked - cluster.start_s)
                kept = made // cluster.checkpoint_s * cluster.checkpoint_s
                lost += made - kept
                left[cell] -= kept
                failures += 1
                heapq.heappush(ends, (now + worked, cell, worker, cluster.replace_s))
            else:
                left[cell] = 0.0
                heapq.heappush(ends, (now + worked, cell, worker, 0.0))
            busy += worked
        end, cell, worker, pause = heapq.heappop(ends)
        makespan = max(makespan, end)
        heapq.heappush(free, (end + pause, worker))
        if left[cell] > 0:
            ready[cell] = end
            queue.append(cell)
    return Outcome(makespan / 3600, busy / 3600, lost / 3600, failures)


def measured(folder: Path) -> dict[str, list[float]]:
    """Seconds of every finished cell of a bench, by row."""
    rows: dict[str, list[float]] = {}
    for path in sorted((folder / "cells").rglob("*.json")):
        record = read_json(path)
        if record["status"] == "done":
            rows.setdefault(record["cell"]["row"], []).append(record["seconds"])
    return rows


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=11.0, help="mean of a cell")
    parser.add_argument("--spread", type=float, default=0.5, help="of the logarithm of minutes")
    parser.add_argument("--from", dest="measured", type=Path, help="results folder of a bench")
    parser.add_argument("--workers", type=int, nargs="+", default=[8, 64, 512])
    parser.add_argument("--failure-hours", type=float, default=24.0, help="0: nothing fails")
    parser.add_argument("--start-seconds", type=float, default=15.0)
    parser.add_argument("--checkpoint-seconds", type=float, default=30.0)
    parser.add_argument("--replace-seconds", type=float, default=180.0)
    parser.add_argument("--price", type=float, default=0.0, help="of a worker's hour")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    if arguments.measured is not None:
        rows = measured(arguments.measured)
        draws = [
            rng.choice(seconds, arguments.captures * arguments.seeds) for seconds in rows.values()
        ]
        # The order of a bench: capture by capture, all rows of each.
        cells_s = np.stack(draws, axis=1).ravel()
    else:
        count = arguments.captures * arguments.rows * arguments.seeds
        sigma = arguments.spread
        noise = rng.lognormal(-(sigma**2) / 2, sigma, count)
        cells_s = 60 * arguments.minutes * noise
    work_h = cells_s.sum() / 3600
    print(f"{len(cells_s)} cells, {work_h:.0f} worker hours of work")
    print("workers   makespan   of the bound   busy      lost    failures   price")
    results: dict[str, float] = {"cells": len(cells_s), "work_h": round(work_h, 2)}
    for workers in arguments.workers:
        cluster = Cluster(
            workers,
            arguments.failure_hours or None,
            arguments.start_seconds,
            arguments.checkpoint_seconds,
            arguments.replace_seconds,
        )
        outcome = simulate(cells_s, cluster, rng)
        bound_h = max(work_h / workers, cells_s.max() / 3600)
        price = outcome.makespan_h * workers * arguments.price
        print(
            f"{workers:7d} {outcome.makespan_h:8.2f} h {outcome.makespan_h / bound_h:14.2f} "
            f"{outcome.busy_h:8.1f} h {outcome.lost_h:6.2f} h {outcome.failures:8d} {price:9.0f}"
        )
        results[f"makespan_h_{workers}"] = round(outcome.makespan_h, 3)
        results[f"over_bound_{workers}"] = round(outcome.makespan_h / bound_h, 3)
        results[f"lost_h_{workers}"] = round(outcome.lost_h, 3)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
