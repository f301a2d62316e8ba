"""A video file, decoded by FFmpeg (PyAV)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.errors import DataError
from evsplat.footage.pictures import TimedPicture, times_of_rate
from evsplat.untrusted.videos import opened_video
from evsplat.wording import counted

# Transfer characteristics of ITU-T H.273: PQ and HLG code light in ways no other part understands.
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
_BT601, _BT709, _UNSPECIFIED = 5, 1, 2
# Players take unmarked video of at least this height for BT.709, the rest for BT.601.
_HD_HEIGHT = 720


class VideoFootage:
    """The first video stream of a file (`Footage`).

    Times are those of the stream, the first 0, or even ones of ``fps``. Pictures are RGB (or grey),
    upright, 16 bit where the video has more than 8.
    """

    def __init__(self, path: Path, fps: float | None, rate_option: str) -> None:
        self.path = path
        first = next(self._decoded(), None)
        if first is None:
            raise DataError(f"{path}: the video holds no picture.")
        if first.color_trc in _HDR_TRANSFERS:
            raise DataError(
                f"{path}: is HDR video ({_HDR_TRANSFERS[first.color_trc]}), expected sRGB or "
                "BT.709; convert it to SDR first."
            )
        with opened_video(path) as (_, stream):
            shape = stream.sample_aspect_ratio
        if shape and shape != 1:  # None or 0 where the file does not say
            raise DataError(
                f"{path}: has pixels {float(shape):.3g} times as wide as high, expected square "
                "ones; make them so with: ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT.mp4"
            )
        self.height, self.width = _pixels(first).shape[:2]
        stamps = self._timestamps()
        if fps is not None:
            self.times_us = times_of_rate(len(stamps), fps)
            return
        if lacking := int(np.isnan(stamps).sum()):
            raise DataError(
                f"{path}: holds no time of {lacking} of {counted(len(stamps), 'picture')}; give "
                f"the rate at which they were taken with {rate_option}."
            )
        self.times_us = np.round((stamps - stamps[0]) * 1e6).astype(np.int64)
        if (np.diff(self.times_us) <= 0).any():
            at = int(np.argmax(np.diff(self.times_us) <= 0)) + 1
            raise DataError(
                f"{path}: pictures {at - 1} and {at} have the same time; give the rate at which "
                f"they were taken with {rate_option}."
            )

    def __iter__(self) -> Iterator[TimedPicture]:
        """The pictures one after the other, as they are decoded."""
        count = 0
        for time_us, frame in zip(self.times_us, self._decoded(), strict=False):
            yield TimedPicture(f"{count:06d}", int(time_us), _pixels(frame))
            count += 1
        if count < len(self.times_us):
            raise DataError(
                f"{self.path}: only {count} of {len(self.times_us)} pictures can be decoded; the "
                "file is damaged, encode it again."
            )

    def _timestamps(self) -> np.ndarray:
        """Seconds of all pictures, ascending, not decoded; NaN where the file has none."""
        with opened_video(self.path) as (container, stream):
            stamps = [
                packet.pts
                for packet in container.demux(stream)
                if packet.size and not packet.is_discard  # the last one is empty
            ]
            return np.sort(np.array(stamps, dtype=np.float64)) * float(stream.time_base)

    def _decoded(self) -> Iterator[Any]:
        with opened_video(self.path) as (container, stream):
            stream.thread_type = "AUTO"
            yield from container.decode(stream)


def _pixels(frame: Any) -> np.ndarray:
    """Upright pixels of a decoded frame."""
    deep = any(component.bits > 8 for component in frame.format.components)
    if frame.format.name.startswith("gray"):
        pixels = frame.to_ndarray(format="gray16le" if deep else "gray")
    else:
        source = frame.colorspace
        if source == _UNSPECIFIED and not frame.format.is_rgb:
            source = _BT709 if frame.height >= _HD_HEIGHT else _BT601
        name = "rgb48le" if deep else "rgb24"
        pixels = frame.reformat(format=name, src_colorspace=source).to_ndarray()
    return np.ascontiguousarray(_upright(pixels, frame))


def _upright(pixels: np.ndarray, frame: Any) -> np.ndarray:
    """Pixels turned by quarters and mirrored as the frame's display matrix says.

    PyAV's ``frame.rotation`` knows no mirror: cameras that film their owner write one.
    """
    said = [data for data in frame.side_data if data.type.name == "DISPLAYMATRIX"]
    if not said:
        return pixels
    # column x and row y are shown at (a x + c y, b x + d y)
    (a, b), (c, d) = np.frombuffer(bytes(said[0]), np.int32).reshape(3, 3)[:2, :2].tolist()
    if abs(b) + abs(c) > abs(a) + abs(d):
        pixels = pixels.swapaxes(0, 1)
        a, d = c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
