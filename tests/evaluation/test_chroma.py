"""Tints apart from brightness."""

import pytest
import torch

from evsplat.evaluation.chroma import chroma_psnr
from evsplat.evaluation.protocols import PSNR_CEILING_DB

MASK = torch.zeros(4, 5, dtype=torch.bool)
MASK[1:3, 1:4] = True


def test_brightness_alone_is_no_tint():
    truth = torch.full((4, 5, 3), 0.2)
    assert chroma_psnr(truth + 0.4, truth, MASK) == {"cb": PSNR_CEILING_DB, "cr": PSNR_CEILING_DB}


def test_a_blue_error_inside_the_mask_counts_by_the_standard():
    truth = torch.full((4, 5, 3), 0.2)
    image = truth.clone()
    image[..., 2][MASK] += 0.2
    image[~MASK] = 1.0
    found = chroma_psnr(image, truth, MASK)
    # BT.601: Cb = 0.5 B + ..., Cr = -0.081312 B + ...
    for name, share in (("cb", 0.5), ("cr", 0.081312)):
        wanted = -20 * torch.log10(torch.tensor(share * 0.2))
        assert found[name] == pytest.approx(float(wanted), abs=0.01)
