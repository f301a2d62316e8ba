"""HUGS (Kocabas et al. 2024): a person read from a triplane, in a scene of its own Gaussians."""

from evsplat.models.hugs.gaussians import SphericalScene, TriplaneHuman
from evsplat.models.hugs.model import HugsModel

__all__ = ["HugsModel", "SphericalScene", "TriplaneHuman"]
