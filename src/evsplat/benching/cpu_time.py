"""CPU time of a training that may be stopped and gone on with."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from evsplat.files import remove_file, write_json
from evsplat.untrusted.records import read_record


@contextmanager
def cpu_time(run: Path, resume: bool) -> Iterator[Callable[[], float | None]]:
    """CPU time of the block, s, and of the processes before it that were stopped and saved.

    None where one of them was killed: nobody knows what it had used.
    """
    spent = run / "cpu_seconds.json"
    before: float | None = None if resume else 0.0
    if resume and spent.exists():
        before = read_record(spent, {"seconds": float}, "remove the run")["seconds"]
        remove_file(spent)
    begun = time.process_time()

    def used() -> float | None:
        return None if before is None else before + time.process_time() - begun

    try:
        yield used
    finally:
        if used() is not None and run.exists():
            write_json(spent, {"seconds": used()})
