"""Snapshots of a run that is being trained, written while someone watches.

The only thing that trainer and watcher share is the run folder. While it trains there is a file
``.watch`` in it, whose lock the trainer holds. A watcher changes that file's time every second or
so; the trainer, seeing this, writes the model to ``snapshot.safetensors`` every few seconds. It
never waits for a watcher.
"""

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from evsplat.errors import TRACEBACK, OutputError
from evsplat.files import remove_file
from evsplat.training.checkpoint import latest_checkpoint, write_state
from evsplat.training_sign import TRAINING_SIGN

SNAPSHOT_SECONDS = 3.0
"""Time between snapshots."""
LARGEST_SHARE = 0.01
"""Of the training's time that goes into snapshots; slow disks see them less often."""
_WATCHED_SECONDS = 10.0
"""A watcher that was not seen for so long has gone."""
_LOOK_SECONDS = 1.0
_FACTS = "versions.json"

logger = logging.getLogger(__name__)


class Showcase:
    """The trainer's side."""

    def __init__(self, run: Path, clock: Callable[[], float] = time.perf_counter) -> None:
        self.sign, self.file = run / TRAINING_SIGN, run / "snapshot.safetensors"
        self._clock = clock
        self._looked = self._shown = -1e9
        self._seen = 0
        self._watched_until = -1e9
        self._pause = SNAPSHOT_SECONDS

    @contextmanager
    def open(self) -> Iterator["Showcase"]:
        """Be there to be watched, in the block of `training_in`; afterwards no snapshot is left."""
        self._seen = self.sign.stat().st_mtime_ns
        remove_file(self.file)
        try:
            yield self
        finally:
            remove_file(self.file)

    def show(self, snapshot: Callable[[], tuple[dict[str, Tensor], dict[str, Any]]]) -> None:
        """Write a snapshot if someone watches and the last one is old; else nothing."""
        now = self._clock()
        if now - self._looked < _LOOK_SECONDS:
            return
        self._looked = now
        try:
            seen = self.sign.stat().st_mtime_ns
        except OSError:
            return
        if seen != self._seen:
            # Only that the time changed counts: the watcher's clock may be another machine's.
            self._seen, self._watched_until = seen, now + _WATCHED_SECONDS
        if now >= self._watched_until or now - self._shown < self._pause:
            return
        tensors, state = snapshot()
        try:
            write_state(self.file, tensors, state)
        except OutputError as error:
            # The training is worth more than being seen.
            logger.warning("no more snapshots for the viewer: %s", error)
            self._pause = float("inf")
            return
        self._shown = self._clock()
        self._pause = max(SNAPSHOT_SECONDS, (self._shown - now) / LARGEST_SHARE)


def is_unused(run: Path) -> bool:
    """Whether a folder holds nothing but what a training that never began left in it."""
    names = {path.name for path in run.iterdir()} if run.exists() else set()
    return all(name in {TRAINING_SIGN, _FACTS} or name.startswith(TRACEBACK) for name in names)


def watch(run: Path) -> None:
    """Ask the trainer for snapshots; where that is not allowed its checkpoints have to do."""
    with suppress(OSError):
        os.utime(run / TRAINING_SIGN)


def newest_state(run: Path) -> Path | None:
    """The snapshot or checkpoint that was written last; None where there is none."""
    found = [run / "snapshot.safetensors", latest_checkpoint(run / "checkpoints")]
    written = [(path.stat().st_mtime_ns, path) for path in found if path and path.exists()]
    return max(written)[1] if written else None
