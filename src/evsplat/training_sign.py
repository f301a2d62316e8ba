"""The sign of a run folder in which a process trains: who holds it, and whether somebody does.

Of no weight, so that the command line can ask before torch is loaded.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evsplat.disk import is_held
from evsplat.files import held_folder

TRAINING_SIGN = ".watch"
"""File in a run folder that is there while it trains, and whose lock the training holds."""


@contextmanager
def training_in(run: Path) -> Iterator[None]:
    """Be the only process that trains in a run folder, which is made where it is missing.

    Raises:
        ConfigError: Another process does.
    """
    busy = "is training in this folder; wait for it or choose another --out."
    with held_folder(run, TRAINING_SIGN, busy):
        yield


def is_training(run: Path) -> bool:
    """Whether a process trains in a run folder now: whether it holds the lock."""
    return is_held(run / TRAINING_SIGN)
