"""Cache of networks' answers: a viewer changes little from picture to picture."""

import copy
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor, nn

from evsplat.models.networks.non_rigid import NonRigid
from evsplat.render.job import same_values


@dataclass(frozen=True)
class Turns:
    """How a draft asks a network about its points: about one in so many, in turns."""

    every: int
    axes: tuple[int | None, ...]
    """Axis of each input that counts the points; None: the input is the same for all of them."""

    def part(self, question: tuple[Any, ...], turn: int) -> tuple[Any, ...]:
        """The question about the points of one turn."""
        rows = slice(turn, None, self.every)
        return tuple(
            value if axis is None else value[(slice(None),) * axis + (rows,)]
            for value, axis in zip(question, self.axes, strict=True)
        )


NETWORKS = {
    "deformation.network": Turns(4, (0, None)),
    "skinning": Turns(16, (1,)),
    "human_colour": Turns(4, (0, 1, 1, None)),
    "scene_colour": Turns(8, (0, 0)),
}
"""Modules of a model that map all Gaussians at once, whose last answer is kept.

Turning the camera asks the first two nothing new; moving in time asks the last nothing new. The
less the answer changes with pose and view, the longer a draft may take to renew it.
"""

_WITHOUT_POSE = {
    f"human.{name}": Turns(1, (0,)) for name in ("triplane", "skinning", "geometry", "appearance")
}
"""Networks of HUGS, which see neither pose nor view: one answer serves all pictures."""


class CachedNetwork(nn.Module):
    """A network with its last answer, given again to the same question.

    With ``rough`` set, another question about as many points renews the answer for the points of
    one turn; the others keep theirs. After all turns of one question the answer is that of the
    network up to rounding, which is good enough for drafts.
    """

    def __init__(self, network: nn.Module, turns: Turns) -> None:
        super().__init__()
        self.network, self.turns = network, turns
        self.rough = False
        self._asked: tuple[Any, ...] = ()
        self._answer: Any = None
        self._turn = 0
        self._known = 0
        """How many turns have been asked the last question."""
        self._exact = False
        """Whether it was asked about all points at once."""

    def __getattr__(self, name: str) -> Any:
        """What is asked of the network itself, such as its sizes."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("network"), name)

    def forward(self, *question: Any) -> Any:
        """The network's answer, new or remembered."""
        asked, every = self._asked, self.turns.every
        known = len(asked) == len(question)
        if known and all(map(_same, question, asked)):
            if self._exact or (self.rough and self._known >= every):
                return self._answer
        else:
            self._known = 0
        if self.rough and every > 1 and known and all(map(_same_size, question, asked)):
            self._renew(self.network(*self.turns.part(question, self._turn)))
            self._turn = (self._turn + 1) % every
            self._known += 1
            self._exact = False
        else:
            self._answer, self._exact = self.network(*question), True
        self._asked = question
        return self._answer

    def _renew(self, part: Any) -> None:
        """Take the answer for the points of this turn; what was given before stays as it is."""
        values = _values(self._answer).clone()
        values[..., self._turn :: self.turns.every, :] = _values(part)
        if isinstance(self._answer, NonRigid):
            self._answer = replace(self._answer, changes=values)
        else:
            self._answer = values


def with_cached_networks(model: nn.Module) -> nn.Module:
    """A shallow copy of a model, with the same parameters, whose networks remember.

    Parameters must not change while it is used; make another one when they have.
    """
    for path, turns in {**NETWORKS, **_WITHOUT_POSE}.items():
        model = _with_cache(model, path, turns)
    return model


def _with_cache(module: nn.Module, path: str, turns: Turns) -> nn.Module:
    """A shallow copy whose module at ``path`` remembers, where there is one."""
    name, _, rest = path.partition(".")
    network = module._modules.get(name)
    if network is None:
        return module
    twin = copy.copy(module)
    inner = _with_cache(network, rest, turns) if rest else CachedNetwork(network, turns)
    twin._modules = {**module._modules, name: inner}
    return twin


def set_rough(model: nn.Module, rough: bool) -> None:
    """Let the networks that remember answer in turns, or exactly."""
    for network in model.modules():
        if isinstance(network, CachedNetwork) and network.turns.every > 1:
            network.rough = rough


def _values(answer: Any) -> Tensor:
    """One row per point along the last axis but one."""
    values: Tensor = answer.changes if isinstance(answer, NonRigid) else answer
    return values


def _same(new: Any, old: Any) -> bool:
    if isinstance(new, Tensor) and isinstance(old, Tensor):
        return same_values(new, old)
    return type(new) is type(old) and bool(new == old)


def _same_size(new: Any, old: Any) -> bool:
    return isinstance(new, Tensor) and isinstance(old, Tensor) and new.shape == old.shape
