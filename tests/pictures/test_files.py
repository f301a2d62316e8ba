"""Pictures come out of files with all the bits that they were stored with."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from evsplat.errors import DataError
from evsplat.pictures.files import holds_16_bits, read_image, to_unit_range
from evsplat.untrusted.pictures import image_size

from ..orientations import UPRIGHT


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("packing", [1, 5, 8])  # none, LZW, Deflate
def test_a_tiff_keeps_its_depth_however_it_is_packed(
    rng: np.random.Generator, tmp_path: Path, channels: int, kind: str, packing: int
) -> None:
    pixels = rng.integers(0, np.iinfo(kind).max, (9, 14, channels), dtype=kind, endpoint=True)
    path = tmp_path / "p.tif"
    assert cv2.imwrite(str(path), pixels[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, packing])
    read = read_image(path)
    assert read.dtype == pixels.dtype
    assert holds_16_bits(path) == (kind == "u2")
    assert np.array_equal(read.reshape(pixels.shape), pixels)


def write_bare_tiff(path: Path, pixels: np.ndarray, orientation: int) -> None:
    """A TIFF of one strip, not packed."""
    height, width, channels = pixels.shape
    data = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
    start, bits = 8, 8 * pixels.itemsize
    long, short = 4, 3
    tags = [
        (256, long, 1, width),
        (257, long, 1, height),
        (258, short, 1, bits),
        (259, short, 1, 1),
        (262, short, 1, 2 if channels == 3 else 1),
        (273, long, 1, start),
        (274, short, 1, orientation),
        (277, short, 1, channels),
        (278, long, 1, height),
        (279, long, 1, len(data)),
    ]
    directory = start + len(data)
    behind = directory + 2 + 12 * len(tags) + 4
    if channels == 3:  # whose three numbers of bits do not fit into their line
        tags[2] = (258, short, 3, behind)
    lines = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    path.write_bytes(
        struct.pack("<2sHI", b"II", 42, directory)
        + data
        + struct.pack("<H", len(tags))
        + lines
        + struct.pack("<I3H", 0, bits, bits, bits)
    )


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_tiff_is_turned_as_it_says(
    rng: np.random.Generator, tmp_path: Path, orientation: int, kind: str, channels: int
) -> None:
    stored = rng.integers(0, np.iinfo(kind).max, (10, 14, channels), dtype=kind, endpoint=True)
    path = tmp_path / "p.tif"
    write_bare_tiff(path, stored, orientation)
    expected = UPRIGHT[orientation](stored)
    read = read_image(path)
    assert read.dtype == stored.dtype
    assert image_size(path) == expected.shape[1::-1] == read.shape[1::-1]
    assert np.array_equal(read.reshape(expected.shape), expected)


def test_a_bitmap_with_16_bits_of_all_colours_reaches_black_and_white(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    levels = rng.integers(0, (32, 64, 32), (6, 8, 3))
    levels[0, :2] = 0, 0, 0
    levels[1, :2] = 31, 63, 31
    words = (levels @ (1 << 11, 1 << 5, 1)).astype("<u2")[::-1].tobytes()
    masks = struct.pack("<3I", 0xF800, 0x07E0, 0x001F)
    header = struct.pack("<IiiHHIIiiII", 40, 8, 6, 1, 16, 3, len(words), 0, 0, 0, 0) + masks
    start = 14 + len(header)
    head = struct.pack("<2sIHHI", b"BM", start + len(words), 0, 0, start)
    (tmp_path / "p.bmp").write_bytes(head + header + words)
    read = read_image(tmp_path / "p.bmp")
    assert read.dtype == np.uint8
    assert not holds_16_bits(tmp_path / "p.bmp")
    assert np.abs(read - levels * 255 / (31, 63, 31)).max() <= 1


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("most", [255, 256, 1_023, 65_535])
def test_a_portable_map_keeps_its_depth_whatever_its_greatest_value(
    rng: np.random.Generator, tmp_path: Path, channels: int, plain: bool, most: int
) -> None:
    levels = rng.integers(0, most, (5, 7, channels), endpoint=True)
    levels[0, 0], levels[-1, -1] = 0, most
    magic = {(1, True): "P2", (3, True): "P3", (1, False): "P5", (3, False): "P6"}
    stored = levels.astype(">u2" if most > 255 else "u1")
    body = " ".join(map(str, levels.ravel())).encode() if plain else stored.tobytes()
    path = tmp_path / "p.pnm"
    path.write_bytes(f"{magic[channels, plain]}\n7 5\n{most}\n".encode() + body)
    read = read_image(path)
    assert read.dtype == (np.uint16 if most > 255 else np.uint8)
    assert holds_16_bits(path) == (most > 255)
    expected = levels / most * np.iinfo(read.dtype).max
    assert np.abs(read.reshape(levels.shape) - expected).max() <= 1


@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_the_depth_of_a_png_is_told_without_its_pixels(
    rng: np.random.Generator, tmp_path: Path, kind: str, channels: int
) -> None:
    pixels = rng.integers(0, np.iinfo(kind).max, (9, 14, channels), dtype=kind, endpoint=True)
    path = tmp_path / "p.png"
    assert cv2.imwrite(str(path), pixels)
    assert holds_16_bits(path) == (read_image(path).dtype == np.uint16) == (kind == "u2")
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"IDAT") + 4])
    with pytest.raises(DataError):
        read_image(path)
    assert holds_16_bits(path) == (kind == "u2")


@pytest.mark.parametrize("kind", ["f4", "i4"])
def test_pixels_of_32_bits_are_refused_not_clipped_at_255(
    rng: np.random.Generator, tmp_path: Path, kind: str
) -> None:
    pixels = rng.uniform(0, 4_000, (9, 14)).astype(kind)
    Image.fromarray(pixels).save(tmp_path / "p.tif")
    with pytest.raises(DataError, match=r"p\.tif: its pixels are .*expected 8 or 16 bits; scale"):
        read_image(tmp_path / "p.tif")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2"])
@pytest.mark.parametrize("lie", ["as stored", "backwards", "planar", "not to be written to"])
def test_every_level_becomes_its_share_of_the_range_rounded_once(kind: str, lie: str) -> None:
    levels = np.arange(np.iinfo(kind).max + 1).astype(kind).reshape(-1, 8, 2)
    if lie == "backwards":
        levels = levels[::-1, ..., ::-1]
    elif lie == "planar":
        levels = np.moveaxis(np.moveaxis(levels, -1, 0).copy(), 0, -1)
    levels.flags.writeable = lie != "not to be written to"
    before = levels.copy()
    shares = (levels.astype(np.float64) / np.iinfo(kind).max).astype(np.float32)
    found = to_unit_range(levels)
    assert np.array_equal(found.numpy(), shares)
    if lie != "backwards":
        assert found.stride() == tuple(step // levels.itemsize for step in levels.strides)
    assert np.array_equal(levels, before)
