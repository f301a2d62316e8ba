"""Method `evsplat`'s person and scene: a closed surface of discs in the light of a room."""

from evsplat.models.discs.model import DiscModel

__all__ = ["DiscModel"]
