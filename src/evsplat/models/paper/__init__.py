"""The paper's person and scene: networks for motion and colour over the Gaussian set."""

from evsplat.models.paper.model import RELEASED, PaperModel, Released, Semantics

__all__ = ["RELEASED", "PaperModel", "Released", "Semantics"]
