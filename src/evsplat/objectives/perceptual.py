"""Perceptual distances that a training run may use, chosen by name."""

import logging
from typing import Literal

import torch

from evsplat.similarity.lpips import load_lpips
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.st_lpips import load_st_lpips
from evsplat.weights import MissingWeights

logger = logging.getLogger(__name__)

PerceptualName = Literal["none", "lpips_vgg", "st_lpips"]
"""``lpips_vgg``: what 3DGS-Avatar trains with; ``st_lpips``: the shift-tolerant AlexNet variant."""
PerceptualChoice = Literal["available", "none", "lpips_vgg", "st_lpips"]
"""``available``: the first of lpips_vgg and st_lpips that has weights, or none."""


def choose_perceptual(
    choice: PerceptualChoice, *, device: torch.device | str
) -> tuple[PerceptualName, PerceptualMetric | None]:
    """The distance of a choice and its name; what was not available is logged with the reason."""
    if choice != "available":
        return choice, make_perceptual(choice, device=device)
    candidates: tuple[PerceptualName, ...] = ("lpips_vgg", "st_lpips")
    for name in candidates:
        try:
            return name, make_perceptual(name, device=device)
        except MissingWeights as error:
            logger.info("No perceptual term %s: %s", name, error)
    return "none", None


def make_perceptual(
    name: PerceptualName, *, device: torch.device | str = "cpu"
) -> PerceptualMetric | None:
    """The distance of that name; missing weights are a `WeightsError` that says how to get them."""
    if name == "none":
        return None
    if name == "lpips_vgg":
        return load_lpips("vgg", device=device)
    return load_st_lpips(device=device)
