"""From what goes wrong to a message and an exit code."""

import logging
import os
import sys
from collections.abc import Callable

from evsplat.errors import EvsplatError

_BAD_INPUT = 2
_INTERRUPTED = 130
_NOBODY_READS = 141


def exit_code(work: Callable[[], object]) -> int:
    """Do what the command line asks for, with its messages; gives the exit code.

    0: done; 2: the input, the machine or an option is at fault (one message on stderr);
    130: stopped by Ctrl-C; 141: the reader of a pipe went away.
    """
    logging.basicConfig(format="%(message)s")
    logging.getLogger("evsplat").setLevel(logging.INFO)
    try:
        try:
            work()
        finally:
            # A reader that went away is noticed here, not at the interpreter's end.
            sys.stdout.flush()
    except EvsplatError as error:
        print(f"evsplat: {error}", file=sys.stderr)
        return _BAD_INPUT
    except KeyboardInterrupt as stop:
        print(f"\nevsplat: {str(stop) or 'Stopped.'}", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # Whoever reads, such as head, has enough. What is still buffered goes nowhere, quietly.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _NOBODY_READS
    return 0
