"""HUGS (Kocabas et al. 2024): a person read from a triplane, in a scene of its own Gaussians."""

from evsplat.models.hugs.human import TriplaneHuman
from evsplat.models.hugs.model import HugsModel
from evsplat.models.hugs.scene import SphericalScene

__all__ = ["HugsModel", "SphericalScene", "TriplaneHuman"]
