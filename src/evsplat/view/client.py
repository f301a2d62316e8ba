"""One browser: its controls, and what it sees by them."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from evsplat.view.camera import Orbit
from evsplat.view.painter import Painter
from evsplat.view.request import ViewRequest
from evsplat.view.resolution import Resolution
from evsplat.view.scheduler import RenderScheduler
from evsplat.view.timeline import Playback

LONGEST_PX = 1600
"""Pictures are drawn no larger; the browser enlarges them to its window."""
_DRAFT_QUALITY, _SHARP_QUALITY = 75, 93
_STANDS_STILL = 2e-3


@dataclass
class Snap:
    """The browser's camera was asked to stand where a recording camera does."""

    position: np.ndarray
    forward: np.ndarray
    arrived: bool = False
    """Whether the browser said that it stands there; what it said before is old."""

    def left(self, camera: viser.CameraHandle) -> bool:
        """Whether the user has moved the browser's camera since."""
        ahead = camera.look_at - camera.position
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        away = np.abs(camera.position - self.position).max() + np.abs(ahead - self.forward).max()
        self.arrived = self.arrived or away < _STANDS_STILL
        return self.arrived and away >= _STANDS_STILL


class Client:
    """Holds the request of a browser; callbacks only write it down, the scheduler does the work."""

    def __init__(
        self,
        handle: viser.ClientHandle,
        painter: Painter,
        scheduler: RenderScheduler,
        request: ViewRequest,
        playback: Playback,
    ) -> None:
        self.handle, self.painter, self.scheduler = handle, painter, scheduler
        self._lock = threading.Lock()
        self._request = request
        self._playback = playback
        self._snap: Snap | None = None
        self._resolution = Resolution()
        self.gone = False
        """Whether the browser has left, perhaps while its picture was drawn."""
        self.on_time: Callable[[int], None] = lambda time_us: None
        """Called by the drawing thread with the time that is shown."""
        handle.camera.on_update(self._camera_moved)

    def change(self, **fields: Any) -> None:
        """Ask for other fields."""
        with self._lock:
            self._request = replace(self._request, **fields)
        self.scheduler.wake()

    def move(self, **fields: Any) -> None:
        """Ask for a motion with other fields."""
        with self._lock:
            self._request = replace(self._request, motion=replace(self._request.motion, **fields))
        self.scheduler.wake()

    def play(self, change: Callable[[Playback, float], Playback]) -> Playback:
        """Change how time goes by."""
        with self._lock:
            self._playback = change(self._playback, time.monotonic())
            playback = self._playback
        self.scheduler.wake()
        return playback

    def look_through(self, camera: str, orbit: Orbit, look_at: np.ndarray) -> None:
        """Go to where a recording camera is; turning the view leaves it again."""
        ahead = look_at - np.asarray(orbit.position)
        with self._lock:
            self._snap = Snap(np.asarray(orbit.position), ahead / np.linalg.norm(ahead))
            self._request = replace(self._request, recording=camera, orbit=orbit)
        with self.handle.atomic():
            self.handle.camera.position = orbit.position
            self.handle.camera.look_at = look_at
            self.handle.camera.fov = orbit.fov
        self.scheduler.wake()

    @property
    def standing(self) -> ViewRequest:
        """The present request, at the time where it stands."""
        with self._lock:
            place = round(self._playback.at(time.monotonic()))
            return replace(self._request, time_us=place)

    def request(self, now: float) -> ViewRequest:
        """The picture to show at a second of the wall clock."""
        with self._lock:
            return replace(self._request, time_us=round(self._playback.at(now)))

    def render(self, request: Any, *, draft: bool) -> None:
        """Draw and send."""
        shrink = min(1.0, LONGEST_PX / max(request.width, request.height))
        size = max(16, round(shrink * request.width)), max(16, round(shrink * request.height))
        if draft:
            size = self._resolution.size(*size)
        started = time.perf_counter()
        picture = self.painter.paint(request, size, rough=draft)
        if self.gone:
            return
        self.handle.scene.set_background_image(
            picture, format="jpeg", jpeg_quality=_DRAFT_QUALITY if draft else _SHARP_QUALITY
        )
        self.handle.flush()
        if draft:
            self._resolution.took(time.perf_counter() - started)
        self.on_time(request.time_us)

    async def _camera_moved(self, camera: viser.CameraHandle) -> None:
        # A coroutine runs in the order of the messages; a function would in a pool of threads.
        orbit = orbit_of(camera)
        width, height = max(16, camera.image_width), max(16, camera.image_height)
        with self._lock:
            if self._snap is not None and self._snap.left(camera):
                self._snap = None
                self._request = replace(self._request, recording=None)
            self._request = replace(self._request, orbit=orbit, width=width, height=height)
        self.scheduler.wake()


def orbit_of(camera: viser.CameraHandle) -> Orbit:
    """Where a browser's camera stands."""
    return Orbit(
        tuple(camera.wxyz.tolist()),
        tuple(camera.position.tolist()),
        float(camera.fov),
    )
