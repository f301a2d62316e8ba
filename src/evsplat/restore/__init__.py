"""Restoration of blurry frames before training: what methods without a blur model start from."""

from evsplat.restore.base import RESTORERS, WEIGHT_FILES, Restorer
from evsplat.restore.capture import restore_capture

__all__ = ["RESTORERS", "WEIGHT_FILES", "Restorer", "restore_capture"]
