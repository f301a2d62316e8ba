"""Videos and folders of pictures: what was put in comes out, with its times."""

import struct
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from PIL import Image

from evsplat.errors import ConfigError, DataError
from evsplat.footage import open_footage
from evsplat.untrusted.pictures import image_size
from evsplat.untrusted.videos import opened_video

from ..orientations import UPRIGHT


def write_video(path: Path, pictures: np.ndarray, stamps: list[int], rate: int = 1000) -> None:
    """Lossless RGB (or 16-bit grey) video with the given times in units of 1 / rate seconds."""
    deep = pictures.dtype == np.uint16
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=rate)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "gray16le" if deep else "bgr0"
        stream.codec_context.time_base = stream.time_base = Fraction(1, rate)
        for picture, stamp in zip(pictures, stamps, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="gray16le" if deep else "rgb24")
            frame = frame if deep else frame.reformat(format="bgr0")
            frame.pts, frame.time_base = stamp, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def some_pictures(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 18, 26, 3), dtype=np.uint8)


def test_video_gives_its_pixels_and_its_uneven_times(tmp_path):
    pictures = some_pictures(5)
    write_video(tmp_path / "clip.mkv", pictures, [40, 50, 75, 80, 120])
    footage = open_footage(tmp_path / "clip.mkv")
    assert (footage.width, footage.height) == (26, 18)
    assert footage.times_us.tolist() == [0, 10_000, 35_000, 40_000, 80_000]
    for turn in range(2):  # a second pass starts again
        read = list(footage)
        assert [picture.time_us for picture in read] == footage.times_us.tolist(), turn
        assert np.array_equal([picture.pixels for picture in read], pictures)
    assert [picture.name for picture in read] == [f"{i:06d}" for i in range(5)]


def test_a_bare_stream_is_told_what_it_wants(tmp_path):
    with av.open(str(tmp_path / "clip.h264"), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "yuv420p"
        for picture in some_pictures(3):
            frame = av.VideoFrame.from_ndarray(picture).reformat(32, 24, "yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(
        DataError, match="clip.h264: is no video with times.* expected MP4.*ffmpeg -framerate"
    ):
        open_footage(tmp_path / "clip.h264")


@pytest.mark.parametrize("without", [{3}, set(range(6))])
def test_pictures_without_times_ask_for_a_rate(tmp_path, monkeypatch, without):
    pictures = some_pictures(6)
    write_video(tmp_path / "clip.mkv", pictures, [0, 40, 80, 120, 160, 200])

    @contextmanager
    def timeless(path):
        def demux(stream):
            for number, packet in enumerate(container.demux(stream)):
                if number in without:
                    packet.pts = packet.dts = None
                yield packet

        with opened_video(path) as (container, stream):
            yield SimpleNamespace(demux=demux, decode=container.decode), stream

    monkeypatch.setattr("evsplat.footage.video.opened_video", timeless)
    message = (
        rf"clip\.mkv: holds no time of {len(without)} of 6 pictures; give the rate .*with fps="
    )
    with pytest.raises(DataError, match=message):
        open_footage(tmp_path / "clip.mkv", rate_option="fps=")
    footage = open_footage(tmp_path / "clip.mkv", fps=25, rate_option="fps=")
    assert footage.times_us.tolist() == [0, 40_000, 80_000, 120_000, 160_000, 200_000]
    assert np.array_equal([picture.pixels for picture in footage], pictures)


def test_sixteen_bit_grey_video_keeps_its_depth(tmp_path):
    pictures = np.random.default_rng(1).integers(0, 2**16, (3, 16, 16), dtype=np.uint16)
    write_video(tmp_path / "deep.mkv", pictures, [0, 1, 2])
    read = [picture.pixels for picture in open_footage(tmp_path / "deep.mkv")]
    assert read[0].dtype == np.uint16 and np.array_equal(read, pictures)


@pytest.mark.parametrize("suffix", [".webp", ".jpg"])
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_picture_is_turned_as_its_camera_was_held(tmp_path, orientation, suffix):
    stored = np.kron(some_pictures(1)[0], np.ones((8, 8, 1), np.uint8))
    exif = Image.Exif()
    exif[274] = orientation
    path = tmp_path / f"a{suffix}"
    options = {"lossless": True} if suffix == ".webp" else {"quality": 100, "subsampling": 0}
    Image.fromarray(stored).save(path, exif=exif, **options)
    footage = open_footage(tmp_path, 25)
    (read,) = (picture.pixels for picture in footage)
    expected = UPRIGHT[orientation](stored)
    assert (footage.height, footage.width) == expected.shape[:2] == read.shape[:2]
    assert np.abs(read.astype(int) - expected).max() <= (0 if suffix == ".webp" else 3)


DISPLAY_MATRIX = {
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}
"""The same as a, b, c, d of ISO 14496-12: column p, row q are shown at (a p + c q, b p + d q)."""


def write_turned_video(path: Path, picture: np.ndarray, matrix: tuple[int, int, int, int]) -> None:
    """A lossless video of one picture, whose track header says how it is shown."""
    with av.open(str(path), "w", format="mov") as container:
        stream = container.add_stream("png", rate=25)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "rgb24"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    stored = path.read_bytes()
    a, b, c, d = (value << 16 for value in matrix)
    upright = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    at = stored.index(upright, stored.index(b"tkhd"))
    turned = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(stored[:at] + turned + stored[at + len(turned) :])


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_video_is_turned_and_mirrored_as_its_camera_says(tmp_path, orientation):
    (stored,) = some_pictures(1)
    write_turned_video(tmp_path / "clip.mov", stored, DISPLAY_MATRIX[orientation])
    footage = open_footage(tmp_path / "clip.mov")
    (read,) = (picture.pixels for picture in footage)
    expected = UPRIGHT[orientation](stored)
    assert (footage.height, footage.width) == expected.shape[:2]
    assert np.array_equal(read, expected)


@pytest.mark.parametrize("suffix", [".webp", ".jpg"])
def test_the_size_of_a_picture_that_is_upright_needs_no_pixels(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    Image.fromarray(np.kron(some_pictures(1)[0], np.ones((8, 8, 1), np.uint8))).save(path)
    height, width = np.asarray(Image.open(path)).shape[:2]
    whole = path.read_bytes()
    path.write_bytes(whole[:-200] + bytes(200))
    assert image_size(path) == (width, height)


@pytest.mark.parametrize("shape, square", [((4, 3), False), ((1, 1), True), ((0, 1), True)])
def test_pixels_that_are_not_square_are_told(tmp_path, shape, square):
    """HDV and DV: a focal length in pixels would be wrong along one side."""
    path = tmp_path / "clip.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(*shape)
        picture = np.full((16, 32, 3), 90, np.uint8)
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        container.mux([*stream.encode(frame), *stream.encode()])
    if square:
        assert open_footage(path).width == 32
        return
    with pytest.raises(DataError, match=r"pixels 1\.33 times as wide as high.*setsar=1"):
        open_footage(path)


def test_given_rate_replaces_the_times_of_a_slow_motion_file(tmp_path):
    write_video(tmp_path / "slow.mkv", some_pictures(4), [0, 33, 67, 100])
    assert open_footage(tmp_path / "slow.mkv", 240).times_us.tolist() == [0, 4167, 8333, 12500]


def test_colours_of_a_usual_video_survive(tmp_path):
    """H.264 of large BT.709 colour patches: within rounding of yuv420p and its coding."""
    from evsplat.pictures.video import write_video as write_h264

    colours = np.random.default_rng(2).integers(30, 226, (3, 4, 3), dtype=np.uint8)
    picture = np.kron(colours, np.ones((16, 16, 1), dtype=np.uint8))
    write_h264(tmp_path / "clip.mp4", [picture] * 3, fps=25, crf=1)
    footage = open_footage(tmp_path / "clip.mp4")
    assert footage.times_us.tolist() == [0, 40_000, 80_000]
    for read in footage:
        centre = read.pixels[8::16, 8::16].astype(int)
        assert np.abs(centre - colours).max() <= 6


def test_folder_counts_numbers_as_numbers(tmp_path):
    pictures = some_pictures(3)
    for name, picture in zip(("f2.png", "f10.png", "f100.png"), pictures, strict=True):
        Image.fromarray(picture).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no picture")
    footage = open_footage(tmp_path, 50)
    assert [picture.name for picture in footage] == ["f2", "f10", "f100"]
    assert np.array_equal([picture.pixels for picture in footage], pictures)
    assert footage.times_us.tolist() == [0, 20_000, 40_000]


def test_folder_with_pictures_of_two_sizes_names_the_odd_one(tmp_path):
    for name, size in (("a.png", 8), ("b.png", 9)):
        Image.fromarray(np.zeros((size, 8), np.uint8)).save(tmp_path / name)
    with pytest.raises(DataError, match=r"b\.png: has 8x9 pixels, expected 8x8"):
        list(open_footage(tmp_path, 10))


def test_what_is_no_footage_is_told(tmp_path):
    with pytest.raises(DataError, match="no such video file"):
        open_footage(tmp_path / "nothing.mp4")
    with pytest.raises(ConfigError, match="with --fps"):
        open_footage(tmp_path, rate_option="--fps")
    with pytest.raises(DataError, match="holds no picture"):
        open_footage(tmp_path, 10)
    with pytest.raises(ConfigError, match="^fps -3"):
        open_footage(tmp_path, -3)
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    with pytest.raises(DataError, match=r"noise\.mp4: cannot be decoded"):
        open_footage(tmp_path / "noise.mp4")


def test_damaged_video_is_not_taken_for_a_shorter_one(tmp_path):
    write_video(tmp_path / "clip.mkv", some_pictures(20), list(range(20)))
    footage = open_footage(tmp_path / "clip.mkv")
    footage.times_us = np.arange(25)
    with pytest.raises(DataError, match="only 20 of 25 pictures"):
        list(footage)
