"""The drawing thread, one for all clients: they share the processor and the caches."""

import logging
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Protocol

logger = logging.getLogger(__name__)

SETTLED_S = 0.15
"""A view that stood still for so long is drawn again, sharp."""
LEAST_S = 1 / 30
"""Pictures of a client follow each other no faster."""


class RenderClient(Protocol):
    """Contract of a client: what it asks for, and who draws it."""

    def request(self, now: float) -> Hashable | None:
        """What shall be seen at wall-clock second ``now``; None: nothing yet."""
        ...

    def render(self, request: Hashable, *, draft: bool) -> None:
        """Draw ``request`` and send it; ``draft`` while it changes."""
        ...


@dataclass(eq=False)
class _Slot:
    client: RenderClient
    shown: Hashable | None = None
    sharp: bool = False
    changed: float = field(default=-1e9)
    """When the last different request was seen."""
    served: float = -1e9


class RenderScheduler:
    """Draws for clients in turn, each its newest request; older ones are forgotten."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._slots: dict[RenderClient, _Slot] = {}
        self._changed = threading.Condition()
        self._awake = False
        self._closed = False
        self._jobs: list[Callable[[], None]] = []
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to serve."""
        self._thread = threading.Thread(target=self._run, name="evsplat-view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop after the picture in hand."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(timeout=10)

    def enter(self, client: RenderClient) -> None:
        """Begin to draw for a client."""
        with self._changed:
            self._slots[client] = _Slot(client)
        self.wake()

    def leave(self, client: RenderClient) -> None:
        """Forget a client."""
        with self._changed:
            self._slots.pop(client, None)

    def wake(self) -> None:
        """Tell that some request may have changed; never waits for a picture."""
        with self._changed:
            self._awake = True
            self._changed.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Have something done between pictures, in the drawing thread."""
        with self._changed:
            self._jobs.append(job)
        self.wake()

    def redraw(self) -> None:
        """Draw everything anew: what requests mean has changed."""
        with self._changed:
            for slot in self._slots.values():
                slot.shown = None
        self.wake()

    def turn(self) -> float | None:
        """Serve whoever needs it, once; seconds until there may be more to do, None: unknown."""
        with self._changed:
            jobs, self._jobs = self._jobs, []
            # Whoever waited longest comes first.
            slots = sorted(self._slots.values(), key=lambda slot: slot.served)
        for job in jobs:
            job()
        pause: float | None = 0.0 if jobs else None
        for slot in slots:
            wait = self._render(slot)
            if wait is not None:
                pause = wait if pause is None else min(pause, wait)
        return pause

    def _render(self, slot: _Slot) -> float | None:
        now = self._clock()
        request = slot.client.request(now)
        if request is None:
            return None
        if request != slot.shown:
            if now - slot.served < LEAST_S:
                return slot.served + LEAST_S - now
            slot.changed, slot.shown, slot.sharp, slot.served = now, request, False, now
            slot.client.render(request, draft=True)
            return 0.0
        if slot.sharp:
            return None
        if now - slot.changed < SETTLED_S:
            return slot.changed + SETTLED_S - now
        slot.sharp, slot.served = True, now
        slot.client.render(request, draft=False)
        return 0.0

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._closed:
                    return
                self._awake = False
            try:
                pause = self.turn()
            except Exception:  # one bad picture must not end the view of everybody
                logger.exception("A picture could not be drawn.")
                pause = 1.0
            if pause == 0.0:
                continue
            with self._changed:
                if not self._awake and not self._closed:
                    self._changed.wait(pause)
