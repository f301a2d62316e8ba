"""One browser: the picture that it asks for, its playback, and drawing and sending pictures."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from evsplat.view.camera import BrowserCamera
from evsplat.view.compositor import Compositor
from evsplat.view.request import Playback, ViewRequest
from evsplat.view.scheduler import DraftResolution, RenderScheduler

LONGEST_PX = 1600
"""Pictures are drawn no larger; the browser enlarges them to its window."""
_DRAFT_QUALITY, _FINAL_QUALITY = 75, 93
_SAME_PLACE = 2e-3
"""Distance in metres and in direction below which two cameras stand at the same place."""


@dataclass
class Snap:
    """The browser's camera was asked to stand where a recording camera does."""

    position: np.ndarray
    forward: np.ndarray
    arrived: bool = False
    """The browser has reported that place; reports before it are old."""

    def left(self, camera: viser.CameraHandle) -> bool:
        """True once the user has moved the browser's camera away."""
        ahead = camera.look_at - camera.position
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        away = np.abs(camera.position - self.position).max() + np.abs(ahead - self.forward).max()
        self.arrived = self.arrived or away < _SAME_PLACE
        return self.arrived and away >= _SAME_PLACE


class Client:
    """State of a browser; its callbacks only write it down, the scheduler has it drawn."""

    def __init__(
        self,
        handle: viser.ClientHandle,
        compositor: Compositor,
        scheduler: RenderScheduler,
        request: ViewRequest,
        playback: Playback,
    ) -> None:
        self.handle, self.compositor, self.scheduler = handle, compositor, scheduler
        self._lock = threading.Lock()
        self._request = request
        self._playback = playback
        self._snap: Snap | None = None
        self._resolution = DraftResolution()
        self.disconnected = False
        """The browser has left, perhaps while its picture was drawn."""
        self.on_drawn: Callable[[int], None] = lambda time_us: None
        """Called by the render thread with the time that is shown."""
        handle.camera.on_update(self._camera_moved)

    def change(self, **fields: Any) -> None:
        """Ask for a picture with other fields."""
        with self._lock:
            self._request = replace(self._request, **fields)
        self.scheduler.notify()

    def change_motion(self, **fields: Any) -> None:
        """Ask for a motion with other fields."""
        with self._lock:
            motion = replace(self._request.motion, **fields)
            self._request = replace(self._request, motion=motion)
        self.scheduler.notify()

    def change_playback(self, change: Callable[[Playback, float], Playback]) -> Playback:
        """Change the playback, given the wall-clock second."""
        with self._lock:
            self._playback = playback = change(self._playback, time.monotonic())
        self.scheduler.notify()
        return playback

    def look_through(self, camera: str, view: BrowserCamera, look_at: np.ndarray) -> None:
        """Go to where a recording camera is; turning the view leaves it again."""
        ahead = look_at - np.asarray(view.position)
        with self._lock:
            self._snap = Snap(np.asarray(view.position), ahead / np.linalg.norm(ahead))
            self._request = replace(self._request, recording_camera=camera, browser_camera=view)
        with self.handle.atomic():
            self.handle.camera.position = view.position
            self.handle.camera.look_at = look_at
            self.handle.camera.fov = view.fov
        self.scheduler.notify()

    @property
    def current(self) -> ViewRequest:
        """The request at the present time."""
        return self.request(time.monotonic())

    def request(self, now: float) -> ViewRequest:
        """The picture to show at a second of the wall clock."""
        with self._lock:
            return replace(self._request, time_us=round(self._playback.at(now)))

    def render(self, request: ViewRequest, *, draft: bool) -> None:
        """Draw a request and send its picture."""
        shrink = min(1.0, LONGEST_PX / max(request.width, request.height))
        size = max(16, round(shrink * request.width)), max(16, round(shrink * request.height))
        if draft:
            size = self._resolution.size(*size)
        started = time.perf_counter()
        picture = self.compositor.compose(request, size, draft=draft)
        if self.disconnected:
            return
        self.handle.scene.set_background_image(
            picture, format="jpeg", jpeg_quality=_DRAFT_QUALITY if draft else _FINAL_QUALITY
        )
        self.handle.flush()
        if draft:
            self._resolution.record(time.perf_counter() - started)
        self.on_drawn(request.time_us)

    async def _camera_moved(self, camera: viser.CameraHandle) -> None:
        # A coroutine runs in the order of the messages; a function would in a pool of threads.
        fields = view_of(camera)
        with self._lock:
            if self._snap is not None and self._snap.left(camera):
                self._snap = None
                self._request = replace(self._request, recording_camera=None)
            self._request = replace(self._request, **fields)
        self.scheduler.notify()


def view_of(camera: viser.CameraHandle) -> dict[str, Any]:
    """Camera and viewport of a browser, as fields of a `ViewRequest`."""
    position = tuple(camera.position.tolist())
    return {
        "browser_camera": BrowserCamera(tuple(camera.wxyz.tolist()), position, float(camera.fov)),
        "width": max(16, camera.image_width),
        "height": max(16, camera.image_height),
    }
