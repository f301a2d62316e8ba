"""Colours of error maps and signed maps."""

import numpy as np
import torch

from evsplat.pictures import error_map, signed_map


def test_error_maps_are_black_for_equal_pictures_and_rise_with_the_error():
    truth = torch.full((1, 5, 3), 0.2)
    picture = truth + torch.tensor([0, 0.05, 0.1, 0.2, 0.6])[None, :, None]
    colours = error_map(picture, truth).astype(int)
    assert colours[0, 0].sum() < 30
    assert (np.diff(colours.sum(axis=-1)[0]) > 0).all()


def test_signed_maps_are_red_for_brighter_blue_for_darker_and_white_for_none():
    red, white, blue = signed_map(torch.tensor([[2.0, 0.0, -2.0]]), 3.0)[0].astype(int)
    assert red[0] > red[2] + 50 and blue[2] > blue[0] + 50 and white.min() > 240
