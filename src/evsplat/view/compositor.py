"""The picture of a request: a run, what it is compared with, recorded events and labels.

Pictures are float32 (H, W, 3), sRGB in [0, 1], until they are labelled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from evsplat.camera import Camera
from evsplat.capture import Capture, Frame
from evsplat.events.maps import count_map
from evsplat.inspection.drawing import BRIGHTER, DARKER, font
from evsplat.methods.trivial import nearest_in_time
from evsplat.view.camera import ViewportPart, letterboxed
from evsplat.view.request import BLURRY, OWN_TRUTH, SHARP, ViewRequest
from evsplat.view.viewed_run import ViewedRun

INSET_SHARE = 0.3
"""Height of the recorded picture in the corner, as a share of the viewport's."""
_FULL_STRENGTH = 3
"""Events at one pixel that hide what is below them."""
_DIMMED = 0.45
"""What is left of the brightness outside of a recorded picture."""

Picture = Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Pane:
    """A part of the viewport with a camera of its own."""

    camera: Camera
    box: ViewportPart | None
    """Box of the recorded picture; None for a camera that recorded nothing."""


class Compositor:
    """Draws requests for one run, or for two runs of one capture."""

    def __init__(self, viewed: ViewedRun, others: Mapping[str, ViewedRun]) -> None:
        """``others`` are runs that it can be compared with, by name."""
        self.viewed, self.others = viewed, dict(others)
        self.capture = viewed.capture

    def compose(
        self, request: ViewRequest, size: tuple[int, int], *, draft: bool
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The picture with ``size`` (width, height) pixels, whatever the viewport has."""
        width, height = size
        other = request.compare if self._can_compare(request) else None
        beside = request.layout == "side by side" and other is not None
        share = 0.5 if beside else 1.0
        pane = self._pane(request, round(share * width), height)
        picture, labels = self._run_picture(self.viewed, pane, request, draft), []
        if other is not None:
            left = self._compared(other, request, pane, picture, draft)
            if beside:
                picture = np.concatenate([left, picture], 1)
                picture[:, left.shape[1] - 1 : left.shape[1] + 1] = 1
            else:
                picture = divided(left, picture, request.divider)
            labels = [
                (0.0, self._named(other, request)),
                (0.5 if beside else request.divider, self.viewed.name),
            ]
        if pane.box is None and (request.events_us is not None or request.compare != other):
            self._add_inset(picture, request)
        return with_labels((picture.clip(0, 1) * 255 + 0.5).astype(np.uint8), labels)

    def camera(self, request: ViewRequest) -> Camera:
        """The camera of a request."""
        return self._pane(request, request.width, request.height).camera

    def _pane(self, request: ViewRequest, width: int, height: int) -> Pane:
        if request.recording_camera is None:
            return Pane(request.browser_camera.sized(width, height), None)
        camera = self.recording(request.recording_camera, request)
        return Pane(*letterboxed(camera, width, height))

    def recording(self, camera: str, request: ViewRequest) -> Camera:
        """A recording camera at the time of a request.

        Another motion has times of its own; the camera then stands where it stood first.
        """
        recorded = request.motion.name is None
        time_us = request.time_us if recorded else self.capture.frames[0].mid_us
        return self.capture.camera_at(camera, time_us)

    def _run_picture(
        self, viewed: ViewedRun, pane: Pane, request: ViewRequest, draft: bool
    ) -> Picture:
        """A run's picture with everything laid over it."""
        time_us, motion, look = request.time_us, request.motion, request.look
        free = request.recording_camera is None
        picture = np.array(
            viewed.picture(pane.camera, time_us, motion, look, draft=draft, elsewhere=free)
        )
        if pane.box is not None:
            dim_outside(picture, pane.box)
            if motion.is_recorded:
                self._add_events(picture, request, pane.box)
        return picture

    def _can_compare(self, request: ViewRequest) -> bool:
        """True where what is compared is known for the view; recordings are for their camera."""
        if request.compare in self.others:
            return True
        frames = [f for f in self.capture.frames if f.camera == request.recording_camera]
        return request.compare is not None and bool(frames) and request.motion.is_recorded

    def _compared(
        self, other: str, request: ViewRequest, pane: Pane, drawn: Picture, draft: bool
    ) -> Picture:
        """The picture at the left of the run's."""
        if other in self.others:
            return self._run_picture(self.others[other], pane, request, draft)
        recorded, picture = self._recorded(request), np.zeros_like(drawn)
        assert pane.box is not None and recorded is not None
        paste(picture, recorded, pane.box)
        return picture

    def _named(self, other: str, request: ViewRequest) -> str:
        """What is compared, by its name; of frames without a sharp truth that is the blurry one."""
        instead = other == SHARP and self._recorded_frame(request).sharp is None
        return f"{BLURRY}, no {SHARP}" if instead else other

    def _add_inset(self, picture: Picture, request: ViewRequest) -> None:
        """Put the recorded picture, with its events, into the lower left corner."""
        recorded = self._recorded(request)
        if recorded is None:
            return
        recorded = recorded.copy()
        self._add_events(
            recorded, request, ViewportPart(0, 0, recorded.shape[1], recorded.shape[0])
        )
        height = INSET_SHARE * picture.shape[0]
        width = height * recorded.shape[1] / recorded.shape[0]
        margin = 0.02 * picture.shape[0]
        box = ViewportPart(margin, picture.shape[0] - margin - height, width, height)
        line = max(1.0, 0.003 * picture.shape[0])
        around = ViewportPart(
            box.left - line, box.top - line, box.width + 2 * line, box.height + 2 * line
        )
        paste(picture, np.ones((2, 2, 3), np.float32), around)
        paste(picture, recorded, box)

    def _recorded_frame(self, request: ViewRequest) -> Frame:
        """The frame nearest in time, of the request's camera where it recorded any."""
        frames = [f for f in self.capture.frames if f.camera == request.recording_camera]
        return nearest_in_time(frames or self.capture.frames, request.time_us)

    def _recorded(self, request: ViewRequest) -> Picture | None:
        """The picture of the recorded frame; None beside another motion."""
        if not request.motion.is_recorded:
            return None
        frame = self._recorded_frame(request)
        if request.compare == SHARP and frame.sharp is not None:
            return self.capture.shown(self.capture.sharp(frame)).numpy()
        return self.capture.shown(self.capture.image(frame)).numpy()

    def _add_events(self, picture: Picture, request: ViewRequest, box: ViewportPart) -> None:
        """Lay the recorded events of the request's window, if it has one, over a picture."""
        store = self.capture.events
        if store is None or request.events_us is None:
            return
        start = request.time_us - request.events_us // 2
        stream = store.between(start, start + request.events_us)
        events_on(picture, count_map(stream, store.height, store.width).numpy(), box)


def comparisons(capture: Capture, others: Sequence[str]) -> list[str]:
    """Everything that a run of this capture can be compared with."""
    known = next((frame for frame in capture.frames if frame.sharp), None)
    if known is None:
        return [BLURRY, *others]
    return [*([OWN_TRUTH] if capture.is_own_truth(known) else [BLURRY, SHARP]), *others]


def events_on(picture: Picture, counts: Float[np.ndarray, "h w"], box: ViewportPart) -> None:
    """Lay signed event counts over the part ``box`` of a picture: red brighter, blue darker."""
    strength = (np.abs(counts) / _FULL_STRENGTH).clip(0, 1) ** 0.5
    brighter, darker = (np.array(colour, np.float32) / 255 for colour in (BRIGHTER, DARKER))
    colour = np.where(counts[..., None] > 0, brighter, darker)
    layer = np.concatenate([colour * strength[..., None], strength[..., None]], -1)
    rows, columns, placed = _placed(layer, box, picture.shape, smooth=False)
    below = picture[rows, columns]
    below *= 1 - placed[..., 3:]
    below += placed[..., :3]


def paste(picture: Picture, other: Picture, box: ViewportPart) -> None:
    """Put a picture into the part ``box`` of another."""
    rows, columns, placed = _placed(other, box, picture.shape, smooth=True)
    picture[rows, columns] = placed


def dim_outside(picture: Picture, box: ViewportPart) -> None:
    """Darken what a recording camera did not see."""
    top, bottom = round(box.top), round(box.top + box.height)
    left, right = round(box.left), round(box.left + box.width)
    picture[:top] *= _DIMMED
    picture[bottom:] *= _DIMMED
    picture[top:bottom, :left] *= _DIMMED
    picture[top:bottom, right:] *= _DIMMED


def divided(left: Picture, right: Picture, share: float) -> Picture:
    """The left picture up to a share of the width, then the right one, with a line between."""
    column = round(share * left.shape[1])
    joined = right.copy()
    joined[:, :column] = left[:, :column]
    if 0 < column < left.shape[1]:
        joined[:, max(0, column - 1) : column + 1] = 1
    return joined


def with_labels(
    pixels: UInt8[np.ndarray, "H W 3"], labels: list[tuple[float, str]]
) -> UInt8[np.ndarray, "H W 3"]:
    """Short texts at the top of a picture, each with the share of the width where it begins."""
    if not labels:
        return pixels
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image, "RGBA")
    size = max(11, round(image.height / 42))
    for share, text in labels:
        x, y = share * image.width + 0.8 * size, 0.8 * size
        left, top, right, bottom = draw.textbbox((x, y), text, font=font(size))
        pad = 0.45 * size
        corners = (left - pad, top - pad, right + pad, bottom + pad)
        draw.rounded_rectangle(corners, radius=0.4 * size, fill=(16, 20, 26, 170))
        draw.text((x, y), text, font=font(size), fill=(255, 255, 255, 255))
    return np.asarray(image)


def _placed(
    layer: Float[np.ndarray, "h w c"], box: ViewportPart, shape: tuple[int, ...], *, smooth: bool
) -> tuple[slice, slice, Float[np.ndarray, "rows columns c"]]:
    """The part of a picture of ``shape`` that the box covers, and the layer at its pixels."""
    top, left = max(0, round(box.top)), max(0, round(box.left))
    bottom = min(shape[0], round(box.top + box.height))
    right = min(shape[1], round(box.left + box.width))
    size = (max(0, right - left), max(0, bottom - top))
    x, y = layer.shape[1] / box.width, layer.shape[0] / box.height
    area = (
        max(0.0, x * (left - box.left)),
        max(0.0, y * (top - box.top)),
        min(float(layer.shape[1]), x * (right - box.left)),
        min(float(layer.shape[0]), y * (bottom - box.top)),
    )
    how = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    channels = [
        np.asarray(
            Image.fromarray(np.ascontiguousarray(layer[..., c], dtype=np.float32)).resize(
                size, how, box=area
            )
        )
        for c in range(layer.shape[-1])
    ]
    return slice(top, bottom), slice(left, right), np.stack(channels, -1)
