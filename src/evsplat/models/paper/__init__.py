"""The paper's person and scene: networks for motion and colour over the Gaussian set."""

from evsplat.models.paper.model import PaperModel, Semantics

__all__ = ["PaperModel", "Semantics"]
