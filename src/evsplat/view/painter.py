"""From a request to the picture that the browser shows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from evsplat.capture import Camera, Capture, Frame
from evsplat.events.maps import count_map
from evsplat.film import camera_at
from evsplat.view import pixels
from evsplat.view.camera import Box, framed, orbit_camera, resized
from evsplat.view.request import BLURRY, SHARP, ViewRequest
from evsplat.view.subject import Subject

INSET_SHARE = 0.3
"""Height of the recorded picture in the corner, as a share of the viewport's."""


@dataclass(frozen=True)
class Pane:
    """A part of the viewport with a camera of its own."""

    camera: Camera
    box: Box | None
    """Where the recorded picture lies; None for a camera that recorded nothing."""


class Painter:
    """Draws requests of one run, or of two runs of one capture."""

    def __init__(self, subject: Subject, others: Mapping[str, Subject]) -> None:
        """``others`` are what the run can be compared with, by name."""
        self.subject, self.others = subject, dict(others)
        self.capture = subject.capture

    @property
    def knows_depth(self) -> bool:
        """Whether every run that is shown can show its depth."""
        return all(s.knows_depth for s in (self.subject, *self.others.values()))

    def paint(
        self, request: ViewRequest, size: tuple[int, int], *, rough: bool
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The picture with ``size`` (width, height) pixels, whatever the viewport has."""
        width, height = size
        other = request.compare if self._has_place(request) else None
        beside = request.layout == "side by side" and other is not None
        share = 0.5 if beside else 1.0
        pane = self._pane(request, round(share * request.width), request.height)
        pane = _scaled(pane, round(share * width), height)
        right = self._drawn(self.subject, pane, request, rough)
        picture, labels = right, []
        if other is not None:
            left = self._compared(other, request, pane, right, rough)
            if beside:
                picture = np.concatenate([left, right], 1)
                picture[:, left.shape[1] - 1 : left.shape[1] + 1] = 1
                labels = [(0.0, other), (0.5, self.subject.name)]
            else:
                picture = pixels.divided(left, right, request.divider)
                labels = [(0.0, other), (request.divider, self.subject.name)]
        if pane.box is None and (request.events_us is not None or request.compare != other):
            self._inset(picture, request)
        return pixels.with_labels(pixels.to_bytes(picture), labels)

    def camera(self, request: ViewRequest) -> Camera:
        """From where a request is seen."""
        return self._pane(request, request.width, request.height).camera

    def frame(self, camera: str | None, time_us: int) -> Frame:
        """The recorded frame nearest in time, of a camera where it recorded any."""
        return nearest_frame(self.capture, camera, time_us)

    def _pane(self, request: ViewRequest, width: int, height: int) -> Pane:
        if request.recording is None:
            return Pane(orbit_camera(request.orbit, width, height), None)
        # Another motion has times of its own; the camera then stands where it stood first.
        time_us = request.time_us if request.motion.name is None else self.capture.frames[0].mid_us
        camera = camera_at(self.capture, request.recording, time_us)
        return Pane(*framed(camera, width, height))

    def _drawn(
        self, subject: Subject, pane: Pane, request: ViewRequest, rough: bool
    ) -> Float[np.ndarray, "H W 3"]:
        """A run's picture with everything laid over it."""
        picture = np.array(
            subject.picture(pane.camera, request.time_us, request.motion, request.look, rough=rough)
        )
        if pane.box is not None:
            pixels.dim_outside(picture, pane.box)
            if request.events_us is not None and request.motion.is_recorded:
                counts = self._events(request)
                if counts is not None:
                    pixels.events_on(picture, counts, pane.box)
        return picture

    def _has_place(self, request: ViewRequest) -> bool:
        """Whether what is compared is known for this view; recordings are for their camera."""
        if request.compare in self.others:
            return True
        frames = [f for f in self.capture.frames if f.camera == request.recording]
        return request.compare is not None and bool(frames) and request.motion.is_recorded

    def _compared(
        self,
        other: str,
        request: ViewRequest,
        pane: Pane,
        drawn: Float[np.ndarray, "H W 3"],
        rough: bool,
    ) -> Float[np.ndarray, "H W 3"]:
        """The picture beside the run's."""
        if other in self.others:
            return self._drawn(self.others[other], pane, request, rough)
        recorded, picture = self._recorded(request), np.zeros_like(drawn)
        assert pane.box is not None and recorded is not None
        pixels.paste(picture, recorded, pane.box)
        return picture

    def _inset(self, picture: Float[np.ndarray, "H W 3"], request: ViewRequest) -> None:
        """Put the recorded picture, with its events, into the lower left corner."""
        recorded = self._recorded(request)
        if recorded is None:
            return
        recorded = recorded.copy()
        if request.events_us is not None:
            counts = self._events(request)
            if counts is not None:
                whole = Box(0, 0, recorded.shape[1], recorded.shape[0])
                pixels.events_on(recorded, counts, whole)
        height = INSET_SHARE * picture.shape[0]
        width = height * recorded.shape[1] / recorded.shape[0]
        margin = 0.02 * picture.shape[0]
        box = Box(margin, picture.shape[0] - margin - height, width, height)
        line = max(1.0, 0.003 * picture.shape[0])
        around = Box(box.left - line, box.top - line, box.width + 2 * line, box.height + 2 * line)
        pixels.paste(picture, np.ones((2, 2, 3), np.float32), around)
        pixels.paste(picture, recorded, box)

    def _recorded(self, request: ViewRequest) -> Float[np.ndarray, "h w 3"] | None:
        if not request.motion.is_recorded:
            return None
        frame = self.frame(request.recording, request.time_us)
        if request.compare == SHARP and frame.sharp is not None:
            return self.capture.sharp(frame).numpy()
        return self.capture.image(frame).numpy()

    def _events(self, request: ViewRequest) -> Float[np.ndarray, "h w"] | None:
        store = self.capture.events
        if store is None or request.events_us is None:
            return None
        start = request.time_us - request.events_us // 2
        stream = store.between(start, start + request.events_us)
        return count_map(stream, store.height, store.width).numpy()


def nearest_frame(capture: Capture, camera: str | None, time_us: int) -> Frame:
    """The frame nearest in time, of a camera where it recorded any."""
    frames: Sequence[Frame] = [f for f in capture.frames if f.camera == camera]
    return min(frames or capture.frames, key=lambda frame: abs(frame.mid_us - time_us))


def comparisons(capture: Capture, others: Sequence[str]) -> list[str]:
    """Everything that a run of this capture can be compared with."""
    truth = [SHARP] if any(frame.sharp for frame in capture.frames) else []
    return [BLURRY, *truth, *others]


def _scaled(pane: Pane, width: int, height: int) -> Pane:
    """The same view with fewer pixels."""
    x, y = width / pane.camera.width, height / pane.camera.height
    box = pane.box
    if box is not None:
        box = Box(x * box.left, y * box.top, x * box.width, y * box.height)
    return Pane(resized(pane.camera, width, height), box)
