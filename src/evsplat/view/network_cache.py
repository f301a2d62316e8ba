"""Cached network outputs: what a viewer changes from picture to picture is little."""

import copy
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor, nn

from evsplat.models.networks.non_rigid import NonRigid
from evsplat.render.job import same_values


@dataclass(frozen=True)
class Interleave:
    """Partial updates of a cached output for drafts: every so many points, in turns."""

    every: int
    """Number of phases; each computes every ``every``-th point."""
    axes: tuple[int | None, ...]
    """Axis of each input that counts the points; None: the input is the same for all of them."""

    def part(self, inputs: tuple[Any, ...], phase: int) -> tuple[Any, ...]:
        """The inputs of the points of one phase."""
        rows = slice(phase, None, self.every)
        return tuple(
            value if axis is None else value[(slice(None),) * axis + (rows,)]
            for value, axis in zip(inputs, self.axes, strict=True)
        )


NETWORKS = {
    "deformation.network": Interleave(4, (0, None)),
    "shade.network": Interleave(4, (0, None)),
    "skinning": Interleave(16, (1,)),
    "human_colour": Interleave(4, (0, 1, 1, None)),
    "scene_colour": Interleave(8, (0, 0)),
}
"""Modules of a model that map all Gaussians at once, whose last output is kept.

Inputs of the first three do not change when the camera turns, those of the last when time moves.
The less the output changes with pose and view, the longer a draft may take to renew it.
"""

_WITHOUT_POSE = {
    f"human.{name}": Interleave(1, (0,))
    for name in ("triplane", "skinning", "geometry", "appearance")
}
"""Networks of HUGS, which see neither pose nor view: one output serves all pictures."""


class CachedNetwork(nn.Module):
    """A network with its last output, given again for the same inputs.

    With ``draft`` set, other inputs of as many points renew the output for the points of one phase;
    the others keep theirs. After all phases of the same inputs the output is that of the network up
    to rounding, which is good enough for drafts.
    """

    def __init__(self, network: nn.Module, interleave: Interleave) -> None:
        super().__init__()
        self.network, self.interleave = network, interleave
        self.draft = False
        self._inputs: tuple[Any, ...] = ()
        self._output: Any = None
        self._phase = 0
        self._phases_done = 0
        """Phases computed with the last inputs."""
        self._is_whole = False
        """The last output was computed for all points at once."""

    def __getattr__(self, name: str) -> Any:
        """Attributes of the network itself, such as its sizes."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("network"), name)

    def forward(self, *inputs: Any) -> Any:
        """The network's output, new or cached."""
        old, every = self._inputs, self.interleave.every
        cached = len(old) == len(inputs)
        if cached and all(map(_same, inputs, old)):
            if self._is_whole or (self.draft and self._phases_done >= every):
                return self._output
        else:
            self._phases_done = 0
        if self.draft and every > 1 and cached and all(map(_same_size, inputs, old)):
            self._update(self.network(*self.interleave.part(inputs, self._phase)))
            self._phase = (self._phase + 1) % every
            self._phases_done += 1
            self._is_whole = False
        else:
            self._output, self._is_whole = self.network(*inputs), True
        self._inputs = inputs
        return self._output

    def _update(self, part: Any) -> None:
        """Take the output for the points of this phase; what was given before stays as it is."""
        values = _values(self._output).clone()
        values[..., self._phase :: self.interleave.every, :] = _values(part)
        if isinstance(self._output, NonRigid):
            self._output = replace(self._output, changes=values)
        else:
            self._output = values


def with_cached_networks(model: nn.Module) -> nn.Module:
    """A shallow copy of a model, with the same parameters, whose networks are cached.

    Parameters must not change while it is used; make another one when they have.
    """
    for path, interleave in {**NETWORKS, **_WITHOUT_POSE}.items():
        model = _with_cache(model, path, interleave)
    return model


def _with_cache(module: nn.Module, path: str, interleave: Interleave) -> nn.Module:
    """A shallow copy whose module at ``path`` is cached, where there is one."""
    name, _, rest = path.partition(".")
    network = module._modules.get(name)
    if network is None:
        return module
    twin = copy.copy(module)
    inner = _with_cache(network, rest, interleave) if rest else CachedNetwork(network, interleave)
    twin._modules = {**module._modules, name: inner}
    return twin


def set_draft(model: nn.Module, draft: bool) -> None:
    """Let cached networks compute in phases, or exactly."""
    for network in model.modules():
        if isinstance(network, CachedNetwork) and network.interleave.every > 1:
            network.draft = draft


def _values(output: Any) -> Tensor:
    """The output's tensor, one row per point along the last axis but one."""
    values: Tensor = output.changes if isinstance(output, NonRigid) else output
    return values


def _same(new: Any, old: Any) -> bool:
    if isinstance(new, Tensor) and isinstance(old, Tensor):
        return same_values(new, old)
    return type(new) is type(old) and bool(new == old)


def _same_size(new: Any, old: Any) -> bool:
    return isinstance(new, Tensor) and isinstance(old, Tensor) and new.shape == old.shape
