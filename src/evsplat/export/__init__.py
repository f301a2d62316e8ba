"""What leaves a run: pictures and videos of the reconstruction."""

from evsplat.export.rendering import camera_at, render_run, rendered_instants
from evsplat.export.video import write_pictures, write_video

__all__ = ["camera_at", "render_run", "rendered_instants", "write_pictures", "write_video"]
