"""Titles below the pictures of a strip: whole where they fit, never over a neighbour's."""

import numpy as np
import pytest

from evsplat.benching.strips import TILE_PX, strip


@pytest.mark.parametrize("wide", [60, 115, 240])
def test_long_titles_go_on_in_the_next_line_and_stay_below_their_picture(wide):
    grey = np.full((TILE_PX, wide, 3), 128, np.uint8)
    titles = ["truth", "EDI + HUGS, from the median backdrop; masks given", "x" * 80]
    page = strip([(title, "27.10 dB mask", grey) for title in titles])
    below = (page[TILE_PX:] != 255).any(axis=(0, 2))
    starts = [i * (wide + 6) for i in range(3)]
    assert all(below[start : start + wide].any() for start in starts)
    assert not any(below[start + wide : start + wide + 4].any() for start in starts[:2])
    short = strip([("truth", "27.10 dB mask", grey)])
    assert len(page) > len(short)


def test_a_mark_that_the_font_lacks_is_left_out():
    grey = np.full((TILE_PX, 200, 3), 128, np.uint8)
    assert np.array_equal(strip([("HUGS†", "", grey)]), strip([("HUGS", "", grey)]))
