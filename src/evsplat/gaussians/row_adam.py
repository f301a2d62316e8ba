"""Adam over the rows of a Gaussian set: moments follow rows when rows are added and removed."""

from jaxtyping import Bool, Int
from torch import Tensor, nn

from evsplat.gaussians.adam import Adam


class RowAdam:
    """One Adam group per attribute, each with its own learning rate (epsilon 1e-15 as 3DGS)."""

    def __init__(
        self, parameters: dict[str, nn.Parameter], learning_rates: dict[str, float]
    ) -> None:
        """Take the attributes by name; a learning rate of 0 freezes one."""
        self.base_rates = dict(learning_rates)
        self.adam = Adam(
            [
                {"params": [parameter], "lr": learning_rates[name], "name": name}
                for name, parameter in parameters.items()
            ],
            eps=1e-15,
        )

    def set_factors(self, factors: dict[str, float]) -> None:
        """Multiply each attribute's learning rate at the start by its factor."""
        for group in self.adam.param_groups:
            group["lr"] = self.base_rates[group["name"]] * factors[group["name"]]

    def zero_grad(self) -> None:
        """Drop gradients."""
        self.adam.zero_grad()

    def move_rows(
        self,
        parameters: dict[str, nn.Parameter],
        source: Int[Tensor, " M"],
        fresh: Bool[Tensor, " M"],
    ) -> None:
        """Take over new parameters whose row ``i`` came from old row ``source[i]``.

        Rows marked ``fresh`` start with zero moments.
        """
        for group in self.adam.param_groups:
            old, new = group["params"][0], parameters[group["name"]]
            state = self.adam.state.pop(old, None)
            group["params"] = [new]
            if not state:
                continue
            for key in ("exp_avg", "exp_avg_sq"):
                moved = state[key][source]
                moved[fresh] = 0
                state[key] = moved
            self.adam.state[new] = state
