"""Adam, and one step of several of them at once."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

_ALONE = 32_768
"""Values on a CPU that one thread steps. Torch wakes all of them for each tensor, the small ones of
networks as well, which takes longer than to step these."""


class Adam:
    """Adam (Kingma and Ba 2015) with decay added to gradients, as `torch.optim.Adam` when fused.

    The first optimiser that torch.optim makes brings PyTorch's compiler along, a second of a core.
    """

    def __init__(
        self,
        parameters: Iterable[Tensor | dict[str, Any]],
        *,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ) -> None:
        """``parameters``: tensors, or groups of ``params`` with values of their own for the rest.

        What else a group holds stays in it.
        """
        given = list(parameters)
        groups = [one for one in given if isinstance(one, dict)] or [{"params": given}]
        defaults = {"lr": lr, "betas": betas, "eps": eps, "weight_decay": weight_decay}
        self.param_groups: list[dict[str, Any]] = [
            {**defaults, **group, "params": list(group["params"])} for group in groups
        ]
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)
        """Of each parameter that has moved: ``step``, ``exp_avg``, ``exp_avg_sq``."""

    @property
    def parameters(self) -> list[Tensor]:
        """Of all groups, in order."""
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def step(self) -> None:
        """Move every parameter that has a gradient."""
        step_together([self])


@torch.no_grad()
def step_together(adams: Iterable[Adam], unsound: Tensor | None = None) -> None:
    """Step every parameter that has a gradient, as each of the ``adams`` would by itself.

    They would count steps group by group, two launches of a GPU for each of the twenty groups of a
    model. Here all are counted together, and groups of one rate are stepped together, on a CPU
    small tensors apart from large ones. Where ``unsound`` is 1 (one value, on the device) nothing
    moves; nobody waits for it.
    """
    rules: defaultdict[tuple[Any, ...], list[tuple[Tensor, dict[str, Tensor]]]] = defaultdict(list)
    for adam in adams:
        for group in adam.param_groups:
            rule = (group["lr"], *group["betas"], group["weight_decay"], group["eps"])
            for parameter in group["params"]:
                if parameter.grad is not None:
                    alone = parameter.device.type == "cpu" and parameter.numel() <= _ALONE
                    rules[alone, *rule].append((parameter, _state(adam, parameter)))
    steps = [state["step"] for members in rules.values() for _, state in members]
    if not steps:
        return
    torch._foreach_add_(steps, 1)
    for (alone, lr, beta1, beta2, weight_decay, eps), members in rules.items():
        states = [state for _, state in members]
        with _one_thread() if alone else nullcontext():
            torch._fused_adam_(
                [parameter for parameter, _ in members],
                [parameter.grad for parameter, _ in members if parameter.grad is not None],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [state["step"] for state in states],
                lr=lr,
                beta1=beta1,
                beta2=beta2,
                weight_decay=weight_decay,
                eps=eps,
                amsgrad=False,
                maximize=False,
                found_inf=unsound,
            )
    if unsound is not None:
        torch._foreach_sub_(steps, [unsound] * len(steps))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Without the other threads of torch."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _state(adam: Adam, parameter: Tensor) -> dict[str, Tensor]:
    """Moments and step count of a parameter, zero at the start."""
    state = adam.state[parameter]
    if not state:
        state["step"] = torch.zeros((), device=parameter.device)
        for name in ("exp_avg", "exp_avg_sq"):
            state[name] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    return state
