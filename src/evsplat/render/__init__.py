"""Drawing posed Gaussians: one function, several backends that give the same numbers."""

from evsplat.render.api import BackendName, choose_device, render
from evsplat.render.backdrop import Backdrop
from evsplat.render.in_view import rows_in_view
from evsplat.render.pictures import split_channels
from evsplat.render.splats import LOW_PASS, PinholeCamera, RenderOutput, Splats

__all__ = [
    "LOW_PASS",
    "BackendName",
    "Backdrop",
    "PinholeCamera",
    "RenderOutput",
    "Splats",
    "choose_device",
    "render",
    "rows_in_view",
    "split_channels",
]
