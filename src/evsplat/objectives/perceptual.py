"""Perceptual distances that a training run may use, chosen by name."""

from typing import Literal

import torch

from evsplat.similarity.lpips import load_lpips
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.st_lpips import load_st_lpips

PerceptualName = Literal["none", "lpips_vgg", "st_lpips"]
"""``lpips_vgg``: what 3DGS-Avatar trains with; ``st_lpips``: the shift-tolerant AlexNet variant."""


def make_perceptual(
    name: PerceptualName, *, device: torch.device | str = "cpu"
) -> PerceptualMetric | None:
    """The distance of that name; missing weights are a `WeightsError` that says how to get them."""
    if name == "none":
        return None
    if name == "lpips_vgg":
        return load_lpips("vgg", device=device)
    return load_st_lpips(device=device)
