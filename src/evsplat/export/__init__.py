"""Files made of a run: pictures, videos, and its Gaussians for other programs."""

from evsplat.export.rendering import render_run
from evsplat.export.run import export_run

__all__ = ["export_run", "render_run"]
