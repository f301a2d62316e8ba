"""The results folder of a bench and its locks."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from evsplat.disk import held
from evsplat.errors import ConfigError
from evsplat.files import make_folder


@dataclass(frozen=True)
class BenchFolder:
    """Paths of the parts of a bench; ``id`` is a cell's ``capture/row/seed0``."""

    path: Path
    kept: Path | None = None
    """Records that are kept elsewhere and count as its own (`benching.kept`)."""

    @property
    def captures(self) -> Path:
        """Captures that the bench made: staged and restored ones."""
        return self.path / "captures"

    def record_of(self, id: str) -> Path:
        """Outcome of a cell, JSON; there when the cell is over."""
        return self.path / "cells" / f"{id}.json"

    def kept_record_of(self, id: str) -> Path | None:
        """Record of a cell among the kept ones, there or not; None where nothing is kept."""
        return None if self.kept is None else self.kept / f"{id}.json"

    def record_there(self, id: str) -> Path | None:
        """The record of a cell that is over, its own or a kept one."""
        paths = (self.record_of(id), self.kept_record_of(id))
        return next((path for path in paths if path is not None and path.exists()), None)

    def run_of(self, id: str) -> Path:
        """Run folder of a cell: checkpoints and pictures."""
        return self.path / "runs" / id

    def request_of(self, id: str) -> Path:
        """The request of a cell that has begun, JSON: what a training that was stopped is of."""
        return self.path / "begun" / f"{id}.json"

    def maker_of(self, capture: Path) -> Path:
        """What a folder in `captures` is made of, JSON."""
        return self.path / "made" / f"{capture.name}.json"

    def log_of(self, id: str) -> Path:
        """Output of a cell's process."""
        return self.path / "logs" / f"{id}.log"

    def lock_of(self, name: str) -> Path:
        """Held while something of this name is being made."""
        return self.path / "locks" / f"{name}.lock"


@contextmanager
def exclusive(lock: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold a lock that ends with this process, however it ends.

    The file holds the process's number. Where the file system has no locks nothing is held: all
    writing is whole or not at all anyway, so that work may be done twice but not spoilt.
    """
    make_folder(lock.parent)
    try:
        with held(lock, wait=wait):
            yield
    except BlockingIOError:
        raise ConfigError(
            f"{lock.parents[1]}: another bench works in this folder; wait for it or choose "
            "another --out."
        ) from None
