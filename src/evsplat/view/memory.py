"""Networks that are not asked twice: what a viewer changes from picture to picture is little."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

NETWORKS = ("non_rigid", "skinning", "human_colour", "scene_colour")
"""Modules of a model that map all Gaussians at once, whose last answer is kept.

Turning the camera asks the first two nothing new; moving in time asks the last nothing new.
"""
ROUGH = ("skinning", "scene_colour")
"""Those that change so little with pose and view that a draft takes their last answer."""


class Remembering(nn.Module):
    """A network with its last answer, given again to the same question.

    With ``rough`` set it is given to any question about as many points.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.rough = False
        self._asked: tuple[Any, ...] | None = None
        self._answer: Any = None

    def __getattr__(self, name: str) -> Any:
        """What is asked of the network itself, such as its sizes."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("network"), name)

    def forward(self, *question: Any) -> Any:
        """The network's answer, new or remembered."""
        if self._asked is not None:
            alike = _same_size if self.rough else _same
            if len(question) == len(self._asked) and all(map(alike, question, self._asked)):
                return self._answer
        self._answer = self.network(*question)
        self._asked = question
        return self._answer


def remembering(model: nn.Module) -> nn.Module:
    """A shallow copy of a model, with the same parameters, whose networks remember.

    Parameters must not change while it is used; make another one when they have.
    """
    twin = copy.copy(model)
    twin._modules = dict(model._modules)
    for name in NETWORKS:
        network = twin._modules.get(name)
        if network is not None:
            twin._modules[name] = Remembering(network)
    return twin


def set_rough(model: nn.Module, rough: bool, names: Sequence[str] = ROUGH) -> None:
    """Let some networks answer from memory, or not."""
    for name in names:
        network = model._modules.get(name)
        if isinstance(network, Remembering):
            network.rough = rough


def _same(new: Any, old: Any) -> bool:
    if isinstance(new, Tensor) and isinstance(old, Tensor):
        return new is old or (new.shape == old.shape and torch.equal(new, old))
    return type(new) is type(old) and bool(new == old)


def _same_size(new: Any, old: Any) -> bool:
    return isinstance(new, Tensor) and isinstance(old, Tensor) and new.shape == old.shape
