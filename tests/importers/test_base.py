import re
from pathlib import Path

import numpy as np
import pytest

from evsplat.errors import ConfigError, DataError
from evsplat.importers import import_capture
from evsplat.importers.base import chosen_frames, shrunk


def test_a_smaller_picture_holds_rounded_means_of_each_channel():
    """By hand; the third column and row fill no square of 2 x 2."""
    red = [[0, 1, 9], [1, 1, 9], [9, 9, 9]]
    green = [[10, 10, 0], [10, 12, 0], [0, 0, 0]]
    pixels = np.stack([red, green], axis=-1).astype(np.uint8)
    small = shrunk(pixels, 2)
    assert small.dtype == np.uint8 and small.shape == (1, 1, 2)
    assert small[0, 0].tolist() == [1, 11]  # 0.75 and 10.5, the half upwards


def test_rows_and_columns_of_a_smaller_picture_stay_where_they_were():
    pixels = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100
    assert shrunk(pixels, 2).tolist() == [[350, 550, 750], [1550, 1750, 1950]]


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3)])
def test_shares_of_a_mask_are_not_rounded(shape):
    mask = np.zeros(shape, np.float32)
    mask[0, 0] = 1
    small = shrunk(mask, 2)
    assert small.shape == (2, 2, *shape[2:])
    assert np.unique(small[0, 0]).tolist() == [0.25] and not small[1:].any()


def test_by_a_factor_of_one_a_picture_is_given_back_itself():
    pixels = np.zeros((3, 3), np.uint8)
    assert shrunk(pixels, 1) is pixels


@pytest.mark.parametrize("frames", [(5, 5), (7, 2)])
def test_frames_that_end_before_they_begin_are_told_so(frames):
    with pytest.raises(ConfigError, match=r"^--frames \d \d: expected the first frame and the one"):
        chosen_frames(frames, list(range(10)), Path("clip.mp4"))
    assert chosen_frames((5, 6), list(range(10)), Path("clip.mp4")) == [5]


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("video", {"frames": (3,)}, "--frames 3: expected [an integer, an integer]"),
        ("video", {"shrink": 1.5}, "--shrink 1.5: expected an integer"),
        ("video", {"focal": "900"}, "--focal '900': expected a number"),
        ("davis", {"contrast": (0.2,)}, "--contrast 0.2: expected [a number, a number]"),
        ("folder", {"clock_offset_us": "aut"}, "--clock-offset-us aut: expected an integer or"),
    ],
)
def test_options_of_another_type_are_refused_before_the_source_is_read(
    tmp_path, kind, options, said
):
    with pytest.raises(ConfigError, match=re.escape(said)):
        import_capture(kind, tmp_path / "nothing", tmp_path / "out", **options)


@pytest.mark.parametrize(
    "options",
    [{"frames": [3, 9]}, {"clock_offset_us": "auto"}, {"homography": "h.txt"}, {"focal": 900}],
)
def test_options_of_the_type_are_taken_and_the_source_is_looked_for(tmp_path, options):
    with pytest.raises(DataError, match="nothing"):
        import_capture("video", tmp_path / "nothing", tmp_path / "out", **options)
