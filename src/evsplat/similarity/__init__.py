"""Similarity of two pictures: PSNR, SSIM, LPIPS, ST-LPIPS; for training terms and evaluation."""

from evsplat.similarity.psnr_ssim import psnr, ssim

__all__ = ["psnr", "ssim"]
