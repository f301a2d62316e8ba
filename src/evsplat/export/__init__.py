"""What leaves a run: pictures and videos of the reconstruction."""

from evsplat.export.rendering import render_run
from evsplat.export.video import write_animation, write_pictures, write_video

__all__ = [
    "render_run",
    "write_animation",
    "write_pictures",
    "write_video",
]
