"""What leaves a run: pictures, videos, and its Gaussians as files for other programs."""

from evsplat.export.rendering import render_run
from evsplat.export.run import export_run
from evsplat.export.video import write_animation, write_pictures, write_video

__all__ = [
    "export_run",
    "render_run",
    "write_animation",
    "write_pictures",
    "write_video",
]
