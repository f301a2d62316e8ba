"""The avatar: a person who plays and can be posed in any browser, without evsplat."""

from evsplat.export.avatar.export import at_rest, export_avatar

__all__ = ["at_rest", "export_avatar"]
