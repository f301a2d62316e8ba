"""The process of one cell: ``python -m evsplat.benching.worker``, started by `LocalPool`."""

import logging
import os
import pickle
import signal
import sys
import threading
from pathlib import Path


def main() -> int:
    """Run the cell that the parent process sends on standard input."""
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
    sys.exit(main())
