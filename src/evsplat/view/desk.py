"""The drawing thread: one for all clients, so that they share the processor and the caches."""

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


class Customer(Protocol):
    """A client as the desk sees it."""

    def wish(self, now: float) -> Hashable | None:
        """What shall be seen at wall-clock second ``now``; None: nothing yet."""
        ...

    def serve(self, wish: Hashable, *, draft: bool) -> None:
        """Draw ``wish`` and send it; ``draft`` while it changes."""
        ...


@dataclass(eq=False)
class _Seat:
    customer: Customer
    shown: Hashable | None = None
    sharp: bool = False
    changed: float = field(default=-1e9)
    """When the last different wish was seen."""
    served: float = -1e9


class Desk:
    """Serves customers in turn, each with its newest wish; what it wished before is forgotten."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seats: dict[Customer, _Seat] = {}
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

    def enter(self, customer: Customer) -> None:
        """Begin to serve a customer."""
        with self._changed:
            self._seats[customer] = _Seat(customer)
        self.wake()

    def leave(self, customer: Customer) -> None:
        """Forget a customer."""
        with self._changed:
            self._seats.pop(customer, None)

    def wake(self) -> None:
        """Tell that some wish may have changed; never waits for a picture."""
        with self._changed:
            self._awake = True
            self._changed.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Have something done between pictures, in the drawing thread."""
        with self._changed:
            self._jobs.append(job)
        self.wake()

    def redraw(self) -> None:
        """Draw everything anew: what wishes mean has changed."""
        with self._changed:
            for seat in self._seats.values():
                seat.shown = None
        self.wake()

    def turn(self) -> float | None:
        """Serve whoever needs it, once; seconds until there may be more to do, None: unknown."""
        with self._changed:
            jobs, self._jobs = self._jobs, []
            # Whoever waited longest comes first.
            seats = sorted(self._seats.values(), key=lambda seat: seat.served)
        for job in jobs:
            job()
        pause: float | None = 0.0 if jobs else None
        for seat in seats:
            wait = self._serve(seat)
            if wait is not None:
                pause = wait if pause is None else min(pause, wait)
        return pause

    def _serve(self, seat: _Seat) -> float | None:
        now = self._clock()
        wish = seat.customer.wish(now)
        if wish is None:
            return None
        if wish != seat.shown:
            if now - seat.served < LEAST_S:
                return seat.served + LEAST_S - now
            seat.changed, seat.shown, seat.sharp, seat.served = now, wish, False, now
            seat.customer.serve(wish, draft=True)
            return 0.0
        if seat.sharp:
            return None
        if now - seat.changed < SETTLED_S:
            return seat.changed + SETTLED_S - now
        seat.sharp, seat.served = True, now
        seat.customer.serve(wish, draft=False)
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
