"""Video files, decoded by FFmpeg (PyAV)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av

from evsplat.errors import DataError
from evsplat.untrusted.faults import ordinary_file, reason

# Containers of video; FFmpeg also knows playlists, which name other files and addresses.
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,m4v,ogg,flv,asf,gif,mxf,nut,ivf"
_EXPECTED = "MP4, MOV, MKV, WebM, AVI or the like"
_OPTIONS = {"protocol_whitelist": "file", "format_whitelist": _FORMATS}
# More than 8K; a damaged header may announce sizes that fill the memory.
_MOST_PIXELS = 40_000_000
_LIMITS = {"max_pixels": str(_MOST_PIXELS)}


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first video stream; what FFmpeg cannot read is a `DataError`."""
    ordinary_file(path)
    try:
        with _container(path) as container:
            if not container.streams.video:
                raise DataError(f"{path}: holds no video stream.")
            stream = container.streams.video[0]
            context = stream.codec_context
            if context is None:
                raise DataError(f"{path}: a video whose codec is not known; encode it again.")
            if context.width * context.height > _MOST_PIXELS:
                raise DataError(
                    f"{path}: pictures of {context.width}x{context.height} pixels, expected at "
                    f"most {_MOST_PIXELS:,}; make them smaller."
                )
            context.options = _LIMITS
            yield container, stream
    except (av.error.FFmpegError, OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or reason(error)
        raise DataError(
            f"{path}: cannot be decoded as video ({why}), expected {_EXPECTED}; encode it again."
        ) from error


def _container(path: Path) -> Any:
    try:
        return av.open(f"file:{path}", options=_OPTIONS)
    except av.error.ArgumentError as error:  # a format that is not in the list
        raise DataError(
            f"{path}: is no video with times, such as a bare stream (.h264) or a playlist, "
            f"expected {_EXPECTED}; make one of a stream with: ffmpeg -framerate HZ -i IN -c copy "
            "OUT.mp4"
        ) from error
