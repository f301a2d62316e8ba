"""Keeping up with runs that are being trained."""

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path

from evsplat.errors import DataError
from evsplat.training.run import Run, load_run
from evsplat.training.watching import is_training, newest_state, watch
from evsplat.view.subject import Subject

_LOOK_SECONDS = 1.0


def yield_to_training() -> None:
    """Let this process have only what processors have left, from now on.

    Reading the run is better done before: it takes seconds once, and without end on what is left.
    """
    if not hasattr(os, "SCHED_IDLE"):
        os.nice(19)
        return
    for thread in threading.enumerate():
        _leave_first(thread.native_id or 0)
    with contextlib.suppress(OSError):  # the pools of threads that Python does not know
        for entry in Path("/proc/self/task").iterdir():
            _leave_first(int(entry.name))


def _leave_first(thread: int) -> None:
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def load_newest(path: Path, device: str) -> Run:
    """The run at its newest checkpoint or snapshot; waits for the first one of a training."""
    while newest_state(path) is None and is_training(path):
        watch(path)
        threading.Event().wait(_LOOK_SECONDS)
    return load_run(path, device=device, state=newest_state(path))


class Follower:
    """Looks for newer states of a run that is being trained, in a thread of its own."""

    def __init__(
        self,
        subject: Subject,
        do: Callable[[Callable[[], None]], None],
        anybody: Callable[[], bool],
        changed: Callable[[], None],
    ) -> None:
        """``do`` has a job done by the drawing thread, ``anybody`` says whether someone watches.

        ``changed`` is called by the drawing thread when the subject has new parameters.
        """
        self.subject, self._do, self._anybody, self._changed = subject, do, anybody, changed
        self._stop = threading.Event()
        self._loaded = self._newest()
        threading.Thread(target=self._run, name="evsplat-follow", daemon=True).start()

    def stop(self) -> None:
        """Look no more."""
        self._stop.set()

    def _run(self) -> None:
        path, training = self.subject.run.path, True
        while training and not self._stop.wait(_LOOK_SECONDS):
            # One more look after the end, for the last checkpoint.
            training = is_training(path)
            if self._anybody():
                watch(path)
            newest = self._newest()
            if newest is not None and newest != self._loaded:
                self._loaded = newest
                self._do(self._reload)

    def _newest(self) -> tuple[Path, int] | None:
        """The newest state and when it was written."""
        with contextlib.suppress(OSError):  # replaced just now
            state = newest_state(self.subject.run.path)
            return None if state is None else (state, state.stat().st_mtime_ns)
        return None

    def _reload(self) -> None:
        assert self._loaded is not None
        try:
            self.subject.reload(self._loaded[0])
        except (DataError, OSError):
            return  # replaced or removed before it was read; there will be another one
        self._changed()
