"""`evsplat poses`: body poses from the pictures and events of one camera."""

from evsplat.posing.find import find_poses

__all__ = ["find_poses"]
