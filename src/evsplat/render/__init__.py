"""Drawing posed Gaussians: one function, several backends that give the same numbers."""

from evsplat.render.api import choose_device, render
from evsplat.render.job import Backdrop, same_memory, same_values
from evsplat.render.native import rows_in_view
from evsplat.render.splats import LOW_PASS, RenderOutput, Splats

__all__ = [
    "LOW_PASS",
    "Backdrop",
    "RenderOutput",
    "Splats",
    "choose_device",
    "render",
    "rows_in_view",
    "same_memory",
    "same_values",
]
