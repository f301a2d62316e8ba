"""Drawing posed Gaussians: one function, several backends that give the same numbers."""

from evsplat.render.api import BackendName, PinholeCamera, RenderOutput, Splats, render

__all__ = ["BackendName", "PinholeCamera", "RenderOutput", "Splats", "render"]
