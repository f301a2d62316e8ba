"""Tints apart from brightness: PSNR of the colour differences Cb and Cr on the person's pixels."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.evaluation.protocols import PSNR_CEILING_DB, eight_bit
from evsplat.pictures import chroma


def chroma_psnr(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"]
) -> dict[str, float]:
    """PSNR in dB of Cb and Cr (ITU-R BT.601, each of range 1) inside of ``mask``; sRGB, 8 bit."""
    values = {}
    error = (eight_bit(image.cpu().double()) - eight_bit(truth.cpu().double()))[mask]
    for name, column in zip(("cb", "cr"), chroma(error).unbind(-1), strict=True):
        square = float(column.square().mean())
        psnr = -10 * torch.log10(torch.tensor(square, dtype=error.dtype)) if square else torch.inf
        values[name] = min(float(psnr), PSNR_CEILING_DB)
    return values
