"""Damaged files of every kind that evsplat reads: each is read rightly or refused in one sentence.

python benchmarks/fuzz.py [--inputs N | --seconds S] [--seed S] [--processes P] [--only NAME ...]

A crash, a hang, half a gigabyte more, an exception other than EvsplatError, or something accepted
although the deep check refuses it is a failure; they are printed by the line that raised them, with
what repeats the first of each. The last line is JSON.
"""

import argparse
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.fuzzing.inputs import Folder, note, rng_of  # noqa: E402
from tests.fuzzing.readers import READERS, Accepted  # noqa: E402

SPACE_BYTES = 3 << 30
"""Address space beyond what the parent has."""
MORE_BYTES = 600 << 20
"""Memory that one input may add to the most so far."""
SECONDS = 20
"""Of processor time for one input, training apart; of the clock six times as many."""


class Slow(BaseException):
    """An input that takes too long; no `Exception`, which a reader might catch."""


@dataclass
class Batch:
    """Numbered inputs of one reader, read in a process of their own."""

    name: str
    first: int
    last: int
    process: Any = None
    receiver: Connection | None = None
    at: Any = None
    """The input that is being read, in shared memory: a crash leaves it there."""
    counts: Counter[str] = field(default_factory=Counter)


def main() -> None:
    """Print failures, a table and one line of JSON; exit with 1 where something failed."""
    options = parsed()
    started = time.monotonic()
    totals: dict[str, Counter[str]] = {name: Counter() for name in options.only}
    groups: dict[str, list[str]] = {}
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        sound = Path(folder) / "sound"
        for name in options.only:
            (sound / name).mkdir(parents=True)
            silent(READERS[name].write, sound / name)
            sound_one = Folder(READERS[name], sound / name, Path(folder) / "first" / name)
            silent(Folder.check_sound, sound_one)
        print(f"sound files written in {time.monotonic() - started:.0f} s", flush=True)
        deadline = time.monotonic() + options.seconds if options.seconds else None
        batches = planned(options, deadline)
        for name, counts, failures in run(batches, options, Path(folder)):
            totals[name].update(counts)
            for group, how in failures:
                groups.setdefault(f"{name}: {group}", []).append(how)
                if len(groups[f"{name}: {group}"]) == 1:
                    print(f"FAILED {name}: {group} | {how}", flush=True)
    report(totals, groups, time.monotonic() - started)
    sys.exit(bool(groups))


def parsed() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, help="in all, spread over readers by their speed")
    parser.add_argument("--seconds", type=float, help="instead of a number")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=list(READERS), default=list(READERS))
    options = parser.parse_args()
    if options.inputs is None and options.seconds is None:
        options.seconds = 60.0
    return options


def planned(options: argparse.Namespace, deadline: float | None) -> Iterator[Batch]:
    """Rounds over all readers, each with its share, until the number or the time is reached."""
    left = options.inputs or sys.maxsize
    whole = sum(READERS[name].share for name in options.only)
    rounds = 0
    while left > 0 and (deadline is None or time.monotonic() < deadline):
        # a small first round, so that a short run reaches every reader
        scale = min(1.0, 0.2 * (rounds + 1)) * min(1.0, left / whole * 2 + 0.01)
        for name in options.only:
            count = min(left, max(1, round(READERS[name].share * scale)))
            if count and (deadline is None or time.monotonic() < deadline):
                first = options.first
                options_first[name] = options_first.get(name, first) + count
                yield Batch(name, options_first[name] - count, options_first[name])
                left -= count
        rounds += 1


options_first: dict[str, int] = {}


def run(
    batches: Iterator[Batch], options: argparse.Namespace, folder: Path
) -> Iterator[tuple[str, Counter[str], list[tuple[str, str]]]]:
    """Results of batches as they end; one whose process dies goes on after the input."""
    running: list[Batch] = []
    again: list[Batch] = []
    number = 0
    while True:
        while len(running) < options.processes:
            batch = again.pop() if again else next(batches, None)
            if batch is None:
                break
            number += 1
            start(batch, options.seed, folder, folder / f"copy{number}")
            running.append(batch)
        if not running:
            return
        ready = wait([batch.receiver for batch in running if batch.receiver], timeout=5)
        for batch in list(running):
            failures: list[tuple[str, str]] = []
            if batch.receiver in ready:
                over = False
                try:
                    kind, what = batch.receiver.recv()
                    if kind == "over":
                        over, batch.counts = True, what
                    else:
                        failures.append(what)
                except EOFError:
                    batch.process.join()
                    failures.append(died(batch, f"died with {batch.process.exitcode}"))
                    over = True
                    again += rest(batch)
            elif time.monotonic() - batch.at[1] > 8 * SECONDS:
                os.kill(batch.process.pid, signal.SIGKILL)
                batch.process.join()
                failures.append(died(batch, "hung"))
                over = True
                again += rest(batch)
            else:
                continue
            if over:
                batch.process.join()
                running.remove(batch)
                yield batch.name, batch.counts, failures
            elif failures:
                yield batch.name, Counter(), failures


def died(batch: Batch, how: str) -> tuple[str, str]:
    """The failure of an input that took its process with it; counts what came before."""
    at = int(batch.at[0])
    batch.counts = Counter({"lost": at - batch.first, "failed": 1})
    return how, f"--only '{batch.name}' --first {at} --inputs 1"


def rest(batch: Batch) -> list[Batch]:
    """What is left of a batch after the input that ended it."""
    at = int(batch.at[0]) + 1
    return [Batch(batch.name, at, batch.last)] if at < batch.last else []


def start(batch: Batch, seed: int, folder: Path, copy: Path) -> None:
    """Fork a process for a batch."""
    context = multiprocessing.get_context("fork")
    batch.receiver, sender = context.Pipe(duplex=False)
    batch.at = context.RawArray("d", [batch.first, time.monotonic()])
    batch.process = context.Process(target=work, args=(batch, seed, folder, copy, sender))
    batch.process.start()
    sender.close()


def work(batch: Batch, seed: int, folder: Path, copy: Path, sender: Connection) -> None:
    """Read one batch within limits of memory and time."""
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    warnings.simplefilter("ignore")
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + SPACE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def too_slow(*_: object) -> None:
        raise Slow(f"more than {SECONDS} seconds")

    signal.signal(signal.SIGALRM, too_slow)
    place = Folder(READERS[batch.name], folder / "sound" / batch.name, copy / "files")
    counts: Counter[str] = Counter()
    for number in range(batch.first, batch.last):
        batch.at[0], batch.at[1] = number, time.monotonic()
        most, before = peak(), time.process_time()
        signal.setitimer(signal.ITIMER_REAL, 6 * SECONDS)
        try:
            counts[place.attempt(rng_of(batch.name, seed, number))] += 1
            assert time.process_time() - before < SECONDS, "slow"
            assert number == batch.first or peak() - most < MORE_BYTES, "memory"
        except BaseException as error:  # noqa: B036 - whatever it is, it is a failure
            counts["accepted" if isinstance(error, Accepted) else "failed"] += 1
            how = f"--only '{batch.name}' --first {number} --inputs 1"
            sender.send(("failed", (note(error), f"{how}: {str(error)[:300]!r}")))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    sender.send(("over", counts))
    with suppress(OSError):
        import shutil

        shutil.rmtree(copy)


def peak() -> int:
    """Most memory of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def silent(work: Any, folder: Any) -> None:
    """Do it without progress bars and warnings."""
    kept = os.dup(2)
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 2)
    try:
        work(folder)
    finally:
        os.dup2(kept, 2)
        os.close(null)


def report(totals: dict[str, Counter[str]], groups: dict[str, list[str]], seconds: float) -> None:
    """The table, the failures by place, and the last line."""
    kinds = ("read", "refused", "accepted", "failed", "lost")
    print(f"{'reader':24s}" + "".join(f"{kind:>10s}" for kind in kinds))
    for name, counts in totals.items():
        print(f"{name:24s}" + "".join(f"{counts[kind]:10d}" for kind in kinds))
    for group, hows in sorted(groups.items(), key=lambda item: -len(item[1])):
        print(f"{len(hows):6d} {group} | {hows[0]}")
    summary = {kind: sum(counts[kind] for counts in totals.values()) for kind in kinds}
    print(
        json.dumps(
            {
                "inputs": sum(summary.values()),
                **summary,
                "groups": len(groups),
                "readers": {name: sum(counts.values()) for name, counts in totals.items()},
                "seconds": round(seconds, 1),
            }
        )
    )


if __name__ == "__main__":
    main()
