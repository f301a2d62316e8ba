"""Pictures come out of files with all the bits that they were stored with."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from evsplat.errors import DataError
from evsplat.pictures.files import read_image


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
    assert np.array_equal(read.reshape(pixels.shape), pixels)


@pytest.mark.parametrize("kind", ["f4", "i4"])
def test_pixels_of_32_bits_are_refused_not_clipped_at_255(
    rng: np.random.Generator, tmp_path: Path, kind: str
) -> None:
    pixels = rng.uniform(0, 4_000, (9, 14)).astype(kind)
    Image.fromarray(pixels).save(tmp_path / "p.tif")
    with pytest.raises(DataError, match=r"p\.tif: its pixels are .*expected 8 or 16 bits; scale"):
        read_image(tmp_path / "p.tif")
