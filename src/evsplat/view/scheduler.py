"""The render thread of all browsers, which share the processor and the caches, and draft sizes."""

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from evsplat.view.request import ViewRequest
from evsplat.wording import in_a_line

logger = logging.getLogger(__name__)

SETTLED_S = 0.15
"""A view that stood still for so long is drawn again in full quality."""
MIN_INTERVAL_S = 1 / 30
"""Pictures of a client follow each other no faster."""
_AFTER_FAILURE_S = 1.0
"""What could not be drawn is tried again no sooner."""
MIN_SCALE = 0.3
_SCALE_STEP = 2**-0.25
"""Ratio of neighbouring draft scales."""
_SCALE_STEPS = math.ceil(math.log(MIN_SCALE) / math.log(_SCALE_STEP))


class RenderClient(Protocol):
    """A browser as the scheduler sees it."""

    def request(self, now: float) -> ViewRequest:
        """The picture to show at wall-clock second ``now``."""
        ...

    def render(self, request: ViewRequest, *, draft: bool) -> None:
        """Draw ``request`` and send it; ``draft`` while it changes."""
        ...


@dataclass(eq=False)
class _ClientState:
    client: RenderClient
    shown: ViewRequest | None = None
    """The request drawn last; None: nothing yet, or what equal requests mean has changed."""
    is_final: bool = False
    """Drawn in full quality, not as a draft."""
    changed_s: float = -1e9
    """Clock when the last different request was seen."""
    drawn_s: float = -1e9


class RenderScheduler:
    """Draws for clients in turn, each its newest request; requests that are overtaken are dropped.

    A request that changes is drawn as a draft, one that has settled in full quality.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._states: dict[RenderClient, _ClientState] = {}
        self._condition = threading.Condition()
        self._notified = False
        self._closed = False
        self._jobs: list[Callable[[], None]] = []
        self._thread: threading.Thread | None = None
        self._said = ""
        """What failed last, in words."""

    def start(self) -> None:
        """Start the render thread."""
        self._thread = threading.Thread(target=self._run, name="evsplat-view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop after the picture that is being drawn."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(timeout=10)

    def add(self, client: RenderClient) -> None:
        """Draw for a client from now on."""
        with self._condition:
            self._states[client] = _ClientState(client)
        self.notify()

    def remove(self, client: RenderClient) -> None:
        """Draw for a client no more."""
        with self._condition:
            self._states.pop(client, None)

    def notify(self) -> None:
        """Say that some request may have changed; never waits for a picture."""
        with self._condition:
            self._notified = True
            self._condition.notify()

    def submit(self, job: Callable[[], None]) -> None:
        """Have ``job`` called between pictures, in the render thread."""
        with self._condition:
            self._jobs.append(job)
        self.notify()

    def redraw(self) -> None:
        """Draw everything anew: equal requests mean other pictures now."""
        with self._condition:
            for state in self._states.values():
                state.shown = None
        self.notify()

    def step(self) -> float | None:
        """Draw for every client that needs it, once; seconds to the next step, None: unknown."""
        with self._condition:
            jobs = len(self._jobs)
            # The client that waited longest comes first.
            states = sorted(self._states.values(), key=lambda state: state.drawn_s)
        for _ in range(jobs):
            with self._condition:
                job = self._jobs.pop(0)
            self._tried(job)
        pause: float | None = 0.0 if jobs else None
        for state in states:
            wait = self._tried(partial(self._draw, state))
            if wait is not None:
                pause = wait if pause is None else min(pause, wait)
        return pause

    def _tried(self, work: Callable[[], float | None]) -> float | None:
        """What ``work`` gives; where it fails a line says so, and others are drawn all the same."""
        try:
            return work()
        except Exception as error:
            said = in_a_line(error)
            if said != self._said:  # what fails may do so at every picture
                logger.warning("A picture could not be drawn or saved (%s).", said)
            self._said = said
            logger.debug("", exc_info=True)
            return _AFTER_FAILURE_S

    def _draw(self, state: _ClientState) -> float | None:
        now = self._clock()
        request = state.client.request(now)
        if request != state.shown:
            if now - state.drawn_s < MIN_INTERVAL_S:
                return state.drawn_s + MIN_INTERVAL_S - now
            state.changed_s = state.drawn_s = now
            state.shown, state.is_final = request, False
            state.client.render(request, draft=True)
            return 0.0
        if state.is_final:
            return None
        if now - state.changed_s < SETTLED_S:
            return state.changed_s + SETTLED_S - now
        # Also where it fails, after which it is asked for again, but not at once.
        state.drawn_s, state.changed_s = now, now + _AFTER_FAILURE_S - SETTLED_S
        state.client.render(request, draft=False)
        state.is_final = True
        return 0.0

    def _run(self) -> None:
        while True:
            with self._condition:
                if self._closed:
                    return
                self._notified = False
            pause = self.step()
            if pause == 0.0:
                continue
            with self._condition:
                if not self._notified and not self._closed:
                    self._condition.wait(pause)


class DraftResolution:
    """Finds the size of drafts that take no longer than ``target_s`` to draw.

    Sizes are few and are left only for good reason: a picture of another size shares nothing with
    the one before.
    """

    def __init__(self, target_s: float = 0.045) -> None:
        self.target_s = target_s
        # In steps below the viewport's size: what is drawn, and what would meet the target.
        self._level = self._wanted = 0.0

    @property
    def scale(self) -> float:
        """Side of the picture drawn, as a share of the viewport's; at most 1."""
        return max(MIN_SCALE, _SCALE_STEP**self._level)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Pixels to draw for a viewport."""
        return max(16, round(self.scale * width)), max(16, round(self.scale * height))

    def record(self, seconds: float) -> None:
        """Learn from a picture that took ``seconds`` at the present scale.

        The scale goes a third of the way to one that would have met the target, so that one slow
        picture does not make the next ones coarse.
        """
        steps = math.log(max(seconds, 1e-4) / self.target_s) / (-2 * math.log(_SCALE_STEP))
        self._wanted += (self._level + steps - self._wanted) / 3
        self._wanted = min(max(self._wanted, 0.0), float(_SCALE_STEPS))
        if abs(self._wanted - self._level) > 0.75:
            self._level = float(round(self._wanted))
