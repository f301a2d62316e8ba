"""The looping clip: the blurry video beside the sharp reconstruction, in slow motion."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import UInt8

from evsplat.camera import distinct
from evsplat.capture import Capture
from evsplat.files import scratch_folder
from evsplat.methods.reconstruction import Reconstruction
from evsplat.methods.trivial import nearest_in_time
from evsplat.pictures import to_bytes
from evsplat.pictures.video import write_video

_PLAYED_HZ = 25
_SLOWER = 5.0
_LONGEST_SECONDS = 8.0
_TIMES_AT_ONCE = 8
_WIDE = 640
"""Small pictures are enlarged by whole factors up to this width, so that pixels stay pixels."""
_LINE = 4
"""Width of the white line between the halves in the video, where whole pixels give it."""


@dataclass(frozen=True)
class Clip:
    """An encoded clip and what a caption needs."""

    mp4: bytes
    slower: float
    """Playing time over recorded time."""
    first_us: int
    last_us: int
    pictures: int


def make_clip(capture: Capture, reconstruction: Reconstruction) -> Clip | None:
    """Both halves over the recording, or over its middle where it is long; None for one frame.

    The left half shows the recorded frame nearest in time; a camera that moves is drawn where it is
    between its frames.
    """
    camera_name = capture.frames[0].camera
    frames = sorted((f for f in capture.frames if f.camera == camera_name), key=lambda f: f.mid_us)
    first, last = frames[0].mid_us, frames[-1].mid_us
    if last <= first:
        return None
    shown_us = min(last - first, int(_LONGEST_SECONDS / _SLOWER * 1e6 * 1.5))
    middle = (first + last) // 2
    first, last = middle - shown_us // 2, middle + shown_us // 2
    count = round(min(shown_us / 1e6 * _SLOWER, _LONGEST_SECONDS) * _PLAYED_HZ)
    times = [round(float(t)) for t in np.linspace(first, last, max(2, count))]
    cameras = capture.cameras_at(camera_name, times)
    at_rest = len(distinct(cameras)) == 1
    camera = capture.cameras[camera_name]
    factor = max(1, _WIDE // camera.width)
    # Of an odd factor an even number of columns, as the video's width has to be even.
    line_px = max(2 if factor % 2 else 1, _LINE // factor)
    line = np.full((camera.height, line_px, 3), 255, np.uint8)
    played_hz = min(_PLAYED_HZ, max(2.0, len(times) / (shown_us / 1e6 * _SLOWER)))

    @lru_cache(maxsize=1)
    def recorded(name: str) -> UInt8[np.ndarray, "H W 3"]:
        return to_bytes(capture.shown(capture.image(name)))

    def pictures() -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        at_once = _TIMES_AT_ONCE if at_rest else 1
        for start in range(0, len(times), at_once):
            batch = times[start : start + at_once]
            nearest = [nearest_in_time(frames, time) for time in batch]
            with torch.no_grad():
                rgb = reconstruction.render(cameras[start], batch).rgb
            for frame, image in zip(nearest, rgb, strict=True):
                halves = recorded(frame.name), to_bytes(capture.shown(image.cpu()))
                yield np.concatenate([halves[0], line, halves[1]], axis=1)

    with scratch_folder() as folder:
        path = folder / "clip.mp4"
        # Half the time of the encoder's usual effort, and no more bytes.
        written = write_video(
            path, pictures(), fps=played_hz, crf=20, preset="veryfast", enlarged=factor
        )
        mp4 = path.read_bytes()
    return Clip(mp4, written / played_hz / (shown_us / 1e6), first, last, written)
