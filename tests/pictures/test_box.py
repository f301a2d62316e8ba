"""Boxes of whole pixels: tight about a mask, inside of the picture."""

import numpy as np
import pytest
import torch

from evsplat.pictures.box import Box, mask_box


@pytest.mark.parametrize("seed", range(4))
def test_mask_box_is_tight(seed):
    rng = np.random.default_rng(seed)
    mask = torch.from_numpy(rng.random((13, 17)) > 0.97)
    box = mask_box(mask)
    rows, columns = np.nonzero(mask.numpy())
    if len(rows) == 0:
        assert box is None
    else:
        assert box == Box(rows.min(), rows.max() + 1, columns.min(), columns.max() + 1)


def test_boxes_stay_inside_the_picture():
    box = Box(1, 39, 2, 58).enlarged(0.1, 40, 60)
    assert box == Box(0, 40, 0, 60)
    assert Box(5, 35, 50, 58).at_least(1.0, 60) == Box(5, 35, 30, 60)
    assert Box(5, 15, 10, 40).at_least(1.0, 60) == Box(5, 15, 10, 40)
