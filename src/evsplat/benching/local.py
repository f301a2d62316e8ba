"""Cells on this machine, each in a process of its own: ``python -m evsplat.benching.local``."""

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

from evsplat.benching.folder import BenchFolder
from evsplat.files import make_folder, open_output

if TYPE_CHECKING:
    # A cell's process imports it once it can be stopped.
    from evsplat.benching.cell import Cell

ATTEMPTS = 3
"""Starts of a cell whose process is killed; it goes on from its checkpoint."""
_LOG_TAIL = 400


@dataclass
class LocalPool:
    """Runs up to ``jobs`` cells at a time."""

    folder: Path
    jobs: int
    threads: int
    """Threads of each cell."""
    device: str
    gpus: int = 0
    """GPUs of this machine; cells take them in turns."""
    _running: set["subprocess.Popen[bytes]"] = field(default_factory=set)
    _stopping: bool = False

    def run(self, cells: Sequence["Cell"]) -> Generator[tuple["Cell", str | None]]:
        """Each cell as it ends, with the reason where its process ended without a record.

        Closing the iterator, and Ctrl-C, stop what runs: training is saved first. A second Ctrl-C
        waits for nothing.
        """
        slots: SimpleQueue[int] = SimpleQueue()
        for slot in range(self.jobs):
            slots.put(slot)
        threads = ThreadPoolExecutor(self.jobs, thread_name_prefix="cell")
        ends: dict[Future[str | None], Cell] = {}
        try:
            for cell in cells:
                ends[threads.submit(self._one, cell, slots)] = cell
            for end in as_completed(ends):
                yield ends[end], end.result()
        finally:
            self._stopping = True
            threads.shutdown(wait=False, cancel_futures=True)
            try:
                self._signal(signal.SIGINT)
                threads.shutdown(wait=True)
            except KeyboardInterrupt:
                self._signal(signal.SIGKILL)
                raise

    def _one(self, cell: "Cell", slots: "SimpleQueue[int]") -> str | None:
        bench = BenchFolder(self.folder)
        record, log = bench.record_of(cell.id), bench.log_of(cell.id)
        slot = slots.get()
        code = 0
        try:
            for _ in range(ATTEMPTS):
                code = self._process(cell, slot, log)
                if record.exists() or self._stopping:
                    return None
                if code >= 0:
                    break
        finally:
            slots.put(slot)
        end = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        tail = log.read_text(encoding="utf-8", errors="replace")[-_LOG_TAIL:].split("\n")[-2:]
        return f"its process {end}: {' '.join(tail).strip() or 'nothing in its log'}"

    def _process(self, cell: "Cell", slot: int, log: Path) -> int:
        """Run the cell's process to its end; gives the exit code, negative for a signal."""
        make_folder(log.parent)
        threads = str(self.threads)
        variables = {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        if self.gpus > 1:
            variables["CUDA_VISIBLE_DEVICES"] = str(slot % self.gpus)
        with open_output(log, "ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "evsplat.benching.local"],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                env={**os.environ, **variables},
                # Ctrl-C on the terminal is for the bench, which tells its cells.
                start_new_session=True,
            )
        assert process.stdin is not None
        self._running.add(process)
        try:
            if self._stopping:
                process.kill()
            # Where it dies at once its exit code tells.
            with suppress(BrokenPipeError):
                pickle.dump((self.folder, cell, self.threads, self.device), process.stdin)
                process.stdin.flush()
            return process.wait()
        finally:
            self._running.discard(process)
            with suppress(BrokenPipeError):
                process.stdin.close()

    def _signal(self, number: int) -> None:
        for process in tuple(self._running):
            process.send_signal(number)


def run_sent_cell() -> int:
    """Run the cell that the parent process sends on standard input; gives the exit code."""
    # A shell that starts the bench in the background has its children ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    from evsplat.benching.cell import run_cell

    # From the parent that started this process, not from a file.
    folder, cell, threads, device = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        run_cell(Path(folder), cell, threads=threads, device=device)
    except KeyboardInterrupt as stop:
        print(str(stop) or "Stopped.", file=sys.stderr)
        return 130
    return 0


def _end_with_parent() -> None:
    """End at once when the parent is gone: nobody would wait for the result.

    The parent never closes its end of the pipe, so its end means that the parent was killed.
    """
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(run_sent_cell())
