"""Writing pictures as H.264 video, WebP or GIF animation or PNG files, whole or not at all."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from evsplat.errors import BackendError, ConfigError, DataError
from evsplat.files import atomic_path, new_folder
from evsplat.meanwhile import meanwhile
from evsplat.names import checked_name

_BT709 = 1
_LIMITED_RANGE = 1
_SLOWEST_HZ = 0.01
"""A GIF's picture stands 655 s at most, and a video below 1/1000 Hz would be played at 24."""


def write_video(
    path: Path | str,
    pictures: Iterable[UInt8[np.ndarray, "H W 3"]],
    *,
    fps: float,
    crf: int = 16,
    preset: str = "medium",
    enlarged: int = 1,
) -> int:
    """Encode sRGB pictures as an mp4 (H.264, yuv420p, BT.709) and return how many there were.

    Odd sizes are made even by repeating the last row or column, as yuv420p asks for. ``fps`` is the
    playing speed in pictures per second, 0.01 to 1000; ``crf`` is x264's quality, lower is better
    (16 is hard to tell from the original), ``preset`` its effort. Each pixel is shown ``enlarged``
    times as wide and as high, so that small pictures stay sharp and keep their colours.
    """
    import av

    _check_rate(fps, 1000, "video")
    if "libx264" not in av.codecs_available:
        raise BackendError(
            "The installed PyAV has no H.264 encoder (libx264): install the wheel with "
            "'pip install --force-reinstall --only-binary av av', or write PNG files "
            "by giving --out a folder."
        )
    with atomic_path(path) as temporary:
        container = av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"})
        even = pictures if enlarged % 2 == 0 else map(_even, pictures)
        options = {"crf": str(crf), "preset": preset}
        if torch.backends.cpu.get_cpu_capability() == "AVX512":
            # With AVX-512 the macroblock tree of PyAV's x264 differs from run to run.
            options["x264-params"] = "asm=avx2"
        count = _encode(container, "libx264", even, fps, "ITU709", enlarged, **options)
        if not count:
            raise DataError(f"{path}: there is no picture to write.")
    return count


def _check_rate(fps: float, most_hz: float, kind: str) -> None:
    if not _SLOWEST_HZ <= fps <= most_hz:
        raise ConfigError(
            f"--fps {fps:g}: expected from {_SLOWEST_HZ:g} to {most_hz:g} Hz of a {kind}."
        )


def _encode(
    container: Any,
    codec: str,
    pictures: Iterable[UInt8[np.ndarray, "H W C"]],
    fps: float,
    colours: str,
    enlarged: int = 1,
    **options: str,
) -> int:
    """Encode RGB or RGBA pictures into an open container and close it; gives their number.

    They are encoded while the next ones are made, so a picture must not be written to again.
    """
    import av
    from av.video.reformatter import VideoReformatter

    count, stream = 0, None
    # Each keeps what it prepared for the pictures before, which takes longer than a small picture.
    convert, enlarge = VideoReformatter(), VideoReformatter()

    def encode(picture: UInt8[np.ndarray, "H W C"], number: int) -> None:
        assert stream is not None
        kind = "rgb24" if picture.shape[2] == 3 else "rgba"
        frame = av.VideoFrame.from_ndarray(picture, format=kind)
        # Enlarged when each pixel has its own Cb and Cr: a fraction of the values to convert.
        frame = convert.reformat(
            frame,
            format=stream.pix_fmt if enlarged == 1 else "yuv444p",
            dst_colorspace=colours,
            dst_color_range=_LIMITED_RANGE,
        )
        if enlarged > 1:
            frame = enlarge.reformat(
                frame, stream.width, stream.height, stream.pix_fmt, interpolation="POINT"
            )
        frame.pts = number
        container.mux(stream.encode(frame))

    with container:
        with meanwhile() as do:
            for picture in pictures:
                if stream is None:
                    stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
                    stream.height, stream.width = (enlarged * side for side in picture.shape[:2])
                    stream.pix_fmt = "yuv420p" if picture.shape[2] == 3 else "yuva420p"
                    stream.options = options
                    if colours == "ITU709":
                        context = stream.codec_context
                        context.colorspace = context.color_primaries = context.color_trc = _BT709
                        context.color_range = _LIMITED_RANGE
                do(encode, picture, count)
                count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def write_animation(
    path: Path | str, pictures: Iterable[UInt8[np.ndarray, "H W C"]], *, fps: float
) -> int:
    """Write a .webp or .gif that plays for ever and return how many pictures there were.

    ``fps`` is from 0.01 to 1000 pictures per second, or to 50 of a GIF.
    RGBA keeps its transparency: all of it in WebP, one bit in GIF. WebP is lossy at a quality that
    is hard to tell from the original; GIF has 255 colours per picture and counts time in 1/100 s,
    so that pictures of some rates stand unequally long but the whole is as long as it should be.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".gif", ".webp"):
        raise ConfigError(f"{path}: animations end in .webp or .gif.")
    _check_rate(fps, 50 if kind == ".gif" else 1000, kind)
    with atomic_path(path) as temporary:
        count = (_write_gif if kind == ".gif" else _write_webp)(temporary, pictures, fps)
        if not count:
            raise DataError(f"{path}: there is no picture to write.")
    return count


def _write_webp(path: Path, pictures: Iterable[UInt8[np.ndarray, "H W C"]], fps: float) -> int:
    import av

    if "libwebp_anim" not in av.codecs_available:
        raise BackendError(
            "The installed PyAV has no encoder of animated WebP (libwebp_anim): install the wheel "
            "with 'pip install --force-reinstall --only-binary av av', or give --out a .gif."
        )
    # For a name in .webp alone a picture's format is guessed; 0: for ever. libwebp takes BT.601.
    container = av.open(str(path), "w", format="webp", options={"loop": "0"})
    return _encode(container, "libwebp_anim", pictures, fps, "ITU601", quality="90")


def _write_gif(path: Path, pictures: Iterable[UInt8[np.ndarray, "H W C"]], fps: float) -> int:
    frames = [_with_palette(picture) for picture in pictures]
    if frames:
        ends = np.rint(np.arange(len(frames) + 1) * 100 / fps).astype(int)
        frames[0].save(
            path,
            save_all=True,
            append_images=frames[1:],
            duration=(10 * np.diff(ends)).tolist(),
            loop=0,
            disposal=2 if "transparency" in frames[0].info else 0,
        )
    return len(frames)


def _with_palette(picture: UInt8[np.ndarray, "H W C"]) -> Image.Image:
    """255 colours, and a transparent one where the picture has alpha."""
    image = Image.fromarray(np.ascontiguousarray(picture[..., :3])).quantize(255)
    if picture.shape[2] == 4:
        image.paste(255, mask=Image.fromarray(np.uint8(255) * (picture[..., 3] < 128)))
        image.info["transparency"] = 255
    return image


def write_pictures(
    folder: Path | str,
    pictures: Iterable[tuple[str, np.ndarray]],
    *,
    replace: bool = False,
) -> int:
    """Write named pictures (RGB, RGBA, 16-bit grey) as ``folder/<name>.png``; gives their count.

    The folder appears only when all are written. One that already holds files is refused, unless
    ``replace`` says that it is ours to replace.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: is a file; give a folder for PNG pictures or a name in .mp4.")
    if not replace and folder.is_dir() and any(folder.iterdir()):
        raise DataError(f"{folder}: the folder is not empty; give a new one to --out.")
    count = 0
    with new_folder(folder, replace=True) as made:
        for name, picture in pictures:
            Image.fromarray(picture).save(made / f"{checked_name(name, 'a picture')}.png")
            count += 1
        if not count:
            raise DataError(f"{folder}: there is no picture to write.")
    return count


def _even(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H2 W2 3"]:
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
