"""The optimisers of a run: Adam over Gaussian rows and Adam over networks."""

from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from evsplat.deform.human_scene import HumanSceneModel
from evsplat.gaussians import ATTRIBUTES, RowAdam
from evsplat.methods.config import NOMINAL_ITERATIONS, LearningRates, OptimisationConfig


class Optimiser:
    """Both Adams with one schedule."""

    def __init__(self, model: HumanSceneModel, config: OptimisationConfig) -> None:
        """Group the model's parameters by learning rate."""
        rates = config.rates
        self.config, self.model = config, model
        gaussians = model.gaussians
        self.rows = RowAdam(
            {name: getattr(gaussians, name) for name in ATTRIBUTES},
            {name: getattr(rates, name) for name in ATTRIBUTES},
        )
        groups: list[tuple[list[nn.Parameter], float, float]] = [
            (list(model.skinning.parameters()), rates.skinning, 0.0),
            (
                [*model.non_rigid.parameters(), *model.pose_encoder.parameters()],
                rates.non_rigid,
                0.0,
            ),
            (
                [*model.human_colour.parameters(), *model.scene_colour.parameters()],
                rates.colour,
                0.0,
            ),
            ([model.latents], rates.latents, rates.latent_weight_decay),
            (
                [model.rotation_residuals, model.translation_residuals],
                rates.pose_correction,
                0.0,
            ),
        ]
        self.clipped = [parameter for parameters, *_ in groups for parameter in parameters]
        groups += [
            (list(part.parameters()), rate, 0.0)
            for part, rate in (
                (model.shading, rates.shading),
                (model.shadow, rates.shadow),
                (model.sensor, rates.sensor),
            )
            if part is not None
        ]
        self.networks = torch.optim.Adam(
            [
                {"params": parameters, "lr": rate, "base": rate, "weight_decay": decay}
                for parameters, rate, decay in groups
            ],
            eps=1e-15,
            fused=True,
        )

    def set_progress(self, nominal: float) -> None:
        """Set all learning rates for a nominal iteration."""
        rates = self.config.rates
        factor = decay(rates, rates.final, nominal)
        self.rows.set_factor(factor, {"means": decay(rates, rates.means_final, nominal)})
        for group in self.networks.param_groups:
            group["lr"] = group["base"] * factor

    def zero_grad(self) -> None:
        """Drop all gradients."""
        self.rows.zero_grad()
        self.networks.zero_grad(set_to_none=True)

    def step(self, nominal: float, sound: Tensor | None = None) -> None:
        """Mask what is frozen, clip the networks' gradient and step both Adams.

        Where ``sound`` is false (one value, on the device) nothing moves; nobody waits for it.
        """
        if sound is not None:
            # What gradient scaling sets to have a fused Adam leave out a step.
            for _, adam in self._adams():
                adam.found_inf = (~sound).float()  # type: ignore[attr-defined]
        gaussians = self.model.gaussians
        if nominal < self.config.human_start:
            for name in ATTRIBUTES:
                gradient = getattr(gaussians, name).grad
                if gradient is not None:
                    gradient[gaussians.human] = 0
        start, end = self.config.semantics_window
        if gaussians.semantic_logits.grad is not None and not start <= nominal < end:
            gaussians.semantic_logits.grad = None
        self.rows.step()
        torch.nn.utils.clip_grad_norm_(self.clipped, self.config.rates.clip_networks)
        self.networks.step()

    def finite(self) -> Bool[Tensor, ""]:
        """Whether every gradient is finite, told on the device."""
        gradients = [
            p.grad
            for adam in (self.rows.adam, self.networks)
            for group in adam.param_groups
            for p in group["params"]
            if p.grad is not None
        ]
        # A sum is NaN or infinite exactly if an entry is (or it overflows, which is as bad).
        return torch.stack([g.sum() for g in gradients]).isfinite().all()

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts, named by group and parameter number."""
        flat: dict[str, Tensor] = {}
        for label, adam in self._adams():
            for number, state in adam.state_dict()["state"].items():
                for key, value in state.items():
                    flat[f"{label}.{number}.{key}"] = torch.as_tensor(value)
        return flat

    def load_state(self, flat: dict[str, Tensor]) -> None:
        """Take back what `state` gave; parameters must have the shapes of that moment."""
        for label, adam in self._adams():
            states: dict[int, dict[str, Any]] = {}
            for name, value in flat.items():
                which, number, key = name.split(".")
                if which == label:
                    states.setdefault(int(number), {})[key] = value
            adam.load_state_dict(
                {"state": states, "param_groups": adam.state_dict()["param_groups"]}
            )

    def _adams(self) -> tuple[tuple[str, torch.optim.Adam], ...]:
        return ("rows", self.rows.adam), ("networks", self.networks)


def decay(rates: LearningRates, final: float, nominal: float) -> float:
    """Factor that is 1 during the constant part and falls exponentially to ``final`` at the end."""
    progress = nominal / NOMINAL_ITERATIONS
    falling = max(0.0, progress - rates.constant) / (1 - rates.constant)
    return final ** min(falling, 1.0)
