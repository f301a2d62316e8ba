"""Restoration of blurry frames before training: what methods without a blur model start from."""

from evsplat.restore.base import RESTORERS, WEIGHT_FILES
from evsplat.restore.capture import restore_capture

__all__ = ["RESTORERS", "WEIGHT_FILES", "restore_capture"]
