"""Measuring a reconstruction: metrics, protocols, trivial rows, tables and the report page."""

from evsplat.evaluation.evaluator import evaluate, evaluate_run
from evsplat.evaluation.lpips import load_lpips
from evsplat.evaluation.metrics import Ssim, psnr, ssim
from evsplat.evaluation.protocols import (
    AVATAR_COMPAT,
    HUGS_COMPAT,
    PROTOCOLS,
    STANDARD,
    Protocol,
)
from evsplat.evaluation.st_lpips import load_st_lpips

__all__ = [
    "AVATAR_COMPAT",
    "HUGS_COMPAT",
    "PROTOCOLS",
    "STANDARD",
    "Protocol",
    "Ssim",
    "evaluate",
    "evaluate_run",
    "load_lpips",
    "load_st_lpips",
    "psnr",
    "ssim",
]
