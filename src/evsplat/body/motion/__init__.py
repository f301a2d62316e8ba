"""Motion capture files as `SkeletonMotion`, which `evsplat.body.retarget` puts on any body."""

from evsplat.body.motion.files import load_motion

__all__ = ["load_motion"]
