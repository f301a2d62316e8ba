"""Damaged recordings of every format: each is read rightly or refused in one sentence.

python benchmarks/event_fuzz.py [--inputs N] [--seed S] [--processes P] [--only NAME]

A crash, a hang of ten seconds, more than a gigabyte, an exception other than DataError, disorder or
pixels beside the sensor in what is read is a failure and is printed with the seed that repeats it.
The last line is JSON.
"""

import argparse
import faulthandler
import json
import multiprocessing
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "events" / "formats"))
import encoders  # noqa: E402
import helpers  # noqa: E402
import mutations  # noqa: E402

MEMORY_BYTES = 1 << 30
SECONDS = 10
BATCH = 250
EVENTS = 300


def main() -> None:
    """Print failures, a table and one line of JSON; exit with 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", help="one kind of recording")
    arguments = parser.parse_args()
    kinds = list(mutations.seeds(encoders, helpers.random_stream(0, EVENTS)))
    kinds = [kind for kind in kinds if arguments.only in (None, kind)]
    batches = [
        (kinds[number % len(kinds)], arguments.seed + number)
        for number in range(-(-arguments.inputs // BATCH))
    ]
    start = time.perf_counter()
    totals: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    failures: list[str] = []
    with tqdm(total=len(batches) * BATCH, unit="input") as progress:
        for kind, counts, failed in run(batches, arguments.processes):
            totals[kind].update(counts)
            failures += failed
            progress.update(BATCH)
    for line in failures[:50]:
        print("FAILED", line)
    print(f"{'recording':15s} {'read':>8s} {'refused':>8s} {'failed':>7s}")
    for kind, counts in totals.items():
        print(f"{kind:15s} {counts['read']:8d} {counts['refused']:8d} {counts['failed']:7d}")
    summary: dict[str, Any] = {
        "inputs": sum(sum(counts.values()) for counts in totals.values()),
        "read": sum(counts["read"] for counts in totals.values()),
        "refused": sum(counts["refused"] for counts in totals.values()),
        "failed": len(failures),
        "kinds": len(kinds),
        "memory_limit_mib": MEMORY_BYTES >> 20,
        "seconds": round(time.perf_counter() - start, 1),
    }
    print(json.dumps(summary))
    sys.exit(bool(failures))


def run(batches: list[tuple[str, int]], processes: int):
    """Results of each batch; a process that dies is a failure of its batch."""
    waiting = list(reversed(batches))
    running: list[tuple[Any, Any, str, int]] = []
    while waiting or running:
        while waiting and len(running) < processes:
            kind, seed = waiting.pop()
            receiver, sender = multiprocessing.Pipe(duplex=False)
            process = multiprocessing.get_context("fork").Process(
                target=work, args=(kind, seed, sender)
            )
            process.start()
            sender.close()
            running.append((process, receiver, kind, seed))
        process, receiver, kind, seed = running.pop(0)
        counts: Counter[str] = Counter()
        failed: list[str] = []
        try:
            while (message := receiver.recv()) is not None:
                counts[message[0]] += 1
                if message[0] == "failed":
                    failed.append(message[1])
        except EOFError:
            number = sum(counts.values())
            counts["failed"] += 1
            process.join()
            failed.append(f"{kind} seed {seed} input {number}: died with {process.exitcode}")
        process.join()
        yield kind, counts, failed


def work(kind: str, seed: int, results: Any) -> None:
    """Read one batch of damaged recordings within limits of memory and time."""
    faulthandler.enable()
    rng = np.random.default_rng(seed)
    stream = helpers.random_stream(seed, EVENTS, gap_us=int(rng.choice([3, 500, 90_000])))
    format, data = mutations.seeds(encoders, stream)[kind]
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    def too_slow(*_: object) -> None:
        raise TimeoutError(f"more than {SECONDS} seconds")

    signal.signal(signal.SIGALRM, too_slow)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording"
        if kind == "bag":
            path = path.with_suffix(".bag")
        for number in range(BATCH):
            path.write_bytes(mutations.damaged(data, rng))
            # processor time: a busy machine is no hang
            signal.setitimer(signal.ITIMER_REAL, 6 * SECONDS)
            before = time.process_time()
            try:
                result = mutations.outcome(path, format, repair=bool(rng.random() < 0.5))
                assert time.process_time() - before < SECONDS, "too slow"
                results.send((result, ""))
            except BaseException as error:  # noqa: B036 - whatever it is, it is a failure
                text = f"{kind} seed {seed} input {number}: {type(error).__name__}: {error}"
                results.send(("failed", text[:300]))
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    results.send(None)


if __name__ == "__main__":
    main()
