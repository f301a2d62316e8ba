"""Methods: compositions of model, objectives and schedules, named in a typed configuration."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from evsplat.config import from_dict
from evsplat.errors import ConfigError
from evsplat.methods import avatar3dgs, hugs, paper
from evsplat.methods.base import Composition, MethodConfig, Purpose, event_use
from evsplat.methods.evsplat import build as build_evsplat
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.methods.settings import NOMINAL_ITERATIONS
from evsplat.untrusted.faults import brief


@dataclass(frozen=True)
class Method:
    """A method that is trained: its file has both."""

    config: type[Any]
    """Frozen dataclass of all its settings, a `MethodConfig`."""
    build: Callable[..., Composition]
    """``build(config, capture, seed, device=, purpose=)``."""
    drawn_by_up: bool = False
    """Whether a trained model is drawn by which way is up: light from above, a floor beyond what
    was recorded. Others begin with it at most."""
    differs: str = ""
    """What tables say below of a baseline that is not quite what its name stands for elsewhere."""


TRAINABLE = {
    "avatar3dgs": Method(avatar3dgs.AvatarConfig, avatar3dgs.build),
    "avatar3dgs_semantic": Method(
        avatar3dgs.AvatarSemanticConfig,
        avatar3dgs.build_semantic,
        differs="3DGS-Avatar of person and scene at once, told apart by the paper's attribute",
    ),
    "evsplat": Method(EvsplatConfig, build_evsplat, drawn_by_up=True),
    "hugs": Method(
        hugs.HugsConfig, hugs.build, differs="HUGS with slips of its released code repaired"
    ),
    "paper": Method(paper.PaperConfig, paper.build),
}
"""Every method that is trained, by name."""

DEFAULT_METHOD = "evsplat"
"""Method of `train` where nothing names one."""


def method_config(method: str, values: dict[str, Any], *, where: str) -> MethodConfig:
    """The configuration of a method with ``values`` over its defaults.

    ``where`` they come from begins what errors say.

    Raises:
        ConfigError: no such method or setting, or a value of another type or out of range.
    """
    if not isinstance(method, str):
        raise ConfigError(f"{where}: method is {brief(method)}; expected a name.")
    if method not in TRAINABLE:
        near = difflib.get_close_matches(method, TRAINABLE, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ConfigError(
            f"--method {brief(method)[1:-1]}: unknown; methods are {', '.join(TRAINABLE)}.{hint}"
        )
    config: MethodConfig = from_dict(TRAINABLE[method].config, values, where=where)
    return config


__all__ = [
    "DEFAULT_METHOD",
    "NOMINAL_ITERATIONS",
    "TRAINABLE",
    "Composition",
    "MethodConfig",
    "Purpose",
    "event_use",
    "method_config",
]
