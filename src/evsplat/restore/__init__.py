"""Restoration of blurry frames before training: what methods without a blur model start from."""

from evsplat.restore.base import RESTORERS, Restorer
from evsplat.restore.capture import restore_capture

__all__ = ["RESTORERS", "Restorer", "restore_capture"]
