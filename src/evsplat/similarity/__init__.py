"""Similarity of two pictures: PSNR, SSIM, LPIPS, ST-LPIPS; for training terms and evaluation."""

from evsplat.similarity.lpips import load_lpips
from evsplat.similarity.psnr_ssim import Ssim, psnr, ssim
from evsplat.similarity.st_lpips import load_st_lpips

__all__ = ["Ssim", "load_lpips", "load_st_lpips", "psnr", "ssim"]
