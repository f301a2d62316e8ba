"""Files of Gaussians that other programs read."""

from evsplat.export.formats.gltf import write_gltf
from evsplat.export.formats.ply import write_ply
from evsplat.export.formats.splat import write_splat
from evsplat.export.formats.spz import write_spz

__all__ = ["write_gltf", "write_ply", "write_splat", "write_spz"]
