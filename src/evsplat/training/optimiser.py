"""The optimisers of a run: Adam over Gaussian rows and Adam over networks."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from evsplat.compiled import native, runs_native
from evsplat.gaussians import Adam, RowAdam, step_together
from evsplat.methods.learning import Learning
from evsplat.models.model import Model

_LARGEST = torch.finfo(torch.float32).max


class Optimiser:
    """One Adam per set of Gaussians and one of all networks, with one clock."""

    def __init__(self, model: Model, learning: Learning) -> None:
        """Take the model's parameters as ``learning`` groups them."""
        self.model, self.learning = model, learning
        self.rows = {
            name: RowAdam(
                {attribute: rows.get_parameter(attribute) for attribute in rows.attributes},
                {
                    attribute: learning.rows[name][attribute].rate.start
                    for attribute in rows.attributes
                },
            )
            for name, rows in model.sets.items()
        }
        self.clipped = [p for group in learning.networks if group.clipped for p in group.parameters]
        self.networks = Adam(
            [
                {
                    "params": group.parameters,
                    "lr": group.rate.start,
                    "weight_decay": group.weight_decay,
                }
                for group in learning.networks
            ],
            eps=1e-15,
        )

    def set_progress(self, nominal: float) -> None:
        """Set all learning rates for a nominal iteration."""
        for name, adam in self.rows.items():
            rates = self.learning.rows[name]
            adam.set_factors({key: row.rate.factor(nominal) for key, row in rates.items()})
        groups = zip(self.networks.param_groups, self.learning.networks, strict=True)
        for group, network in groups:
            group["lr"] = network.rate.start * network.rate.factor(nominal)

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for adam in self.rows.values():
            adam.zero_grad()
        self.networks.zero_grad()

    def step(self, nominal: float, unsound: Float[Tensor, ""] | None = None) -> None:
        """Mask what is frozen, clip the networks' gradient and step all Adams.

        Where ``unsound`` is 1 (one value, on the device) nothing moves; nobody waits for it.
        """
        for name, rows in self.model.sets.items():
            for attribute in rows.attributes:
                parameter = rows.get_parameter(attribute)
                start, end = self.learning.rows[name][attribute].window
                if not start <= nominal < end:
                    parameter.grad = None
                elif nominal < self.learning.human_start and parameter.grad is not None:
                    parameter.grad[rows.human] = 0
        if self.learning.clip is not None:
            _clip([p.grad for p in self.clipped if p.grad is not None], self.learning.clip)
        step_together([adam for _, adam in self._adams()], unsound)

    def step_only(self, parameters: list[nn.Parameter], gradients: Sequence[Tensor]) -> None:
        """Step these parameters of networks, by these gradients, and nothing else.

        Gradients that are not finite move nothing.
        """
        self.zero_grad()
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        unsound = (~self.finite()).float()
        on_host = unsound.device.type == "cpu"
        if not (on_host and bool(unsound)):
            step_together([self.networks], None if on_host else unsound)

    def finite(self, *others: Tensor) -> Bool[Tensor, ""]:
        """Whether every gradient is finite, and ``others`` are, told on the device."""
        gradients = [
            p.grad
            for _, adam in self._adams()
            for group in adam.param_groups
            for p in group["params"]
            if p.grad is not None
        ]
        # A sum is NaN or infinite exactly if an entry is (or it overflows, which is as bad).
        values = [*others, *gradients]
        if all(map(runs_native, values)):
            arrays = [value.contiguous() for value in values]
            total = native.sum_of_magnitudes(arrays, torch.get_num_threads())
            return torch.tensor(total < _LARGEST)
        return (torch.stack(torch._foreach_norm(values, 1)) < torch.inf).all()

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts, named by group and parameter number."""
        flat: dict[str, Tensor] = {}
        for label, adam in self._adams():
            for number, parameter in enumerate(adam.parameters):
                for key, value in adam.state.get(parameter, {}).items():
                    flat[f"{label}.{number}.{key}"] = value
        return flat

    def load_state(self, flat: dict[str, Tensor]) -> None:
        """Take back what `state` gave; parameters must have the shapes of that moment.

        Raises:
            ValueError: They have not, or some moments are missing: Adam would read beyond them.
        """
        for label, adam in self._adams():
            states: dict[int, dict[str, Tensor]] = {}
            for name, value in flat.items():
                which, number, key = name.rsplit(".", 2)
                if which == label:
                    states.setdefault(int(number), {})[key] = value
            parameters = adam.parameters
            for place, moments in states.items():
                shapes = [tuple(moments[key].shape) for key in ("exp_avg", "exp_avg_sq")]
                expected = tuple(parameters[place].shape)
                if any(shape != expected for shape in shapes):
                    raise ValueError(
                        f"optimiser.{label}.{place} has moments of shapes {shapes}, expected "
                        f"{expected}"
                    )
            adam.state.clear()
            for place, moments in states.items():
                adam.state[parameters[place]] = {
                    key: value.to(parameters[place]).clone() for key, value in moments.items()
                }

    def learning_rates(self) -> dict[str, float]:
        """Learning rates of the Gaussians' attributes, for the log."""
        several = len(self.rows) > 1
        return {
            f"{name}.{group['name']}" if several else group["name"]: group["lr"]
            for name, adam in self.rows.items()
            for group in adam.adam.param_groups
        }

    def _adams(self) -> list[tuple[str, Adam]]:
        rows = [(name, adam.adam) for name, adam in self.rows.items()]
        return [*rows, ("networks", self.networks)]


def _clip(gradients: list[Tensor], most: float) -> None:
    """Shrink gradients to a norm together, in as few operations as there can be."""
    if gradients:
        norm = torch.stack(torch._foreach_norm(gradients)).norm()
        torch._foreach_div_(gradients, (norm / most).clamp_min(1.0))
