"""Methods: compositions of model, objectives and schedules, named in a typed configuration."""

import difflib
from collections.abc import Callable
from typing import Any

from evsplat.config import from_dict
from evsplat.errors import ConfigError
from evsplat.methods.avatar3dgs import AvatarConfig
from evsplat.methods.avatar3dgs import compose as compose_avatar3dgs
from evsplat.methods.avatar3dgs_semantic import AvatarSemanticConfig
from evsplat.methods.avatar3dgs_semantic import compose as compose_avatar3dgs_semantic
from evsplat.methods.composition import Composition
from evsplat.methods.config import NOMINAL_ITERATIONS, MethodConfig
from evsplat.methods.evsplat import EvsplatConfig
from evsplat.methods.evsplat import compose as compose_evsplat
from evsplat.methods.hugs import HugsConfig
from evsplat.methods.hugs import compose as compose_hugs
from evsplat.methods.paper import PaperConfig, compose

TRAINABLE: dict[str, tuple[type[Any], Callable[..., Composition]]] = {
    "avatar3dgs": (AvatarConfig, compose_avatar3dgs),
    "avatar3dgs_semantic": (AvatarSemanticConfig, compose_avatar3dgs_semantic),
    "evsplat": (EvsplatConfig, compose_evsplat),
    "hugs": (HugsConfig, compose_hugs),
    "paper": (PaperConfig, compose),
}
"""Configuration and composition of every method that is trained."""

DEFAULT_METHOD = "evsplat"
"""What `train` takes where nothing names a method."""


def method_config(method: str, values: dict[str, Any], *, where: str) -> MethodConfig:
    """The configuration of a method with ``values`` over its defaults."""
    if method not in TRAINABLE:
        near = difflib.get_close_matches(method, TRAINABLE, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ConfigError(f"--method {method}: unknown; methods are {', '.join(TRAINABLE)}.{hint}")
    config: MethodConfig = from_dict(TRAINABLE[method][0], values, where=where)
    return config


__all__ = [
    "DEFAULT_METHOD",
    "NOMINAL_ITERATIONS",
    "TRAINABLE",
    "Composition",
    "MethodConfig",
    "PaperConfig",
    "compose",
    "method_config",
]
