"""Importing what a verb needs."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def kept_objects() -> Iterator[None]:
    """Around imports: their objects stay, so that the garbage collector need not look at them.

    PyTorch, SciPy and our modules make 230,000 of them. Going through these time and again is a
    seventh of the time of an import.
    """
    collects, first = gc.isenabled(), "torch" not in sys.modules
    gc.disable()
    try:
        yield
    finally:
        if first:  # later on what is not collected yet would stay as well
            gc.freeze()
        if collects:
            gc.enable()
