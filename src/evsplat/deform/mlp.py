"""A leaky-ReLU MLP for many points at several times, near the speed of its matrix products.

The first layer is split by what its inputs depend on, so that nothing is repeated: inputs per point
(an encoding), per time (a pose, given as the finished bias) and per point and time (a direction).
Points go through all layers in chunks whose activations stay in the processor's cache.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

SLOPE = 0.01
"""Of the leaky ReLU, as 3DGS-Avatar."""
_ROWS = 4096
"""Rows (points x times) per chunk: two activations of width 128 fill 4 MB."""


class PointMLP(nn.Module):
    """Linear and leaky-ReLU layers over points and times; linear at the end.

    Weights start as PyTorch's linear layers do, except that ``last_std`` (if given) draws those of
    the last layer from N(0, last_std^2) with zero bias, so that the output starts near zero.
    """

    def __init__(
        self,
        per_point: int,
        per_time: int,
        per_both: int,
        width: int,
        depth: int,
        out: int,
        last_std: float | None = None,
    ) -> None:
        super().__init__()
        fan_in = per_point + per_time + per_both
        self.point_weight = nn.Parameter(_uniform((width, per_point), fan_in))
        self.time_weight = nn.Parameter(_uniform((width, per_time), fan_in))
        self.both_weight = nn.Parameter(_uniform((width, per_both), fan_in))
        self.first_bias = nn.Parameter(_uniform((width,), fan_in))
        sizes = [width] * depth + [out]
        self.weights = nn.ParameterList(_uniform((o, i), i) for i, o in zip(sizes, sizes[1:]))
        self.biases = nn.ParameterList(_uniform((o,), i) for i, o in zip(sizes, sizes[1:]))
        if last_std is not None:
            nn.init.normal_(self.weights[-1], std=last_std)
            nn.init.zeros_(self.biases[-1])

    def forward(
        self,
        point: Float[Tensor, "N A"],
        time: Float[Tensor, "T B"] | None = None,
        both: Float[Tensor, "T N C"] | None = None,
    ) -> Float[Tensor, "T N out"]:
        """Values for every point at every time; without ``time`` and ``both`` T is 1."""
        bias = self.first_bias[None]
        if time is not None:
            bias = torch.addmm(self.first_bias, time, self.time_weight.T)
        elif both is not None:
            bias = bias.expand(len(both), -1)
        layers = [layer for pair in zip(self.weights, self.biases, strict=True) for layer in pair]
        output: Tensor = _ChunkedMLP.apply(
            point, both, bias, self.point_weight, self.both_weight, *layers
        )
        return output


class _ChunkedMLP(torch.autograd.Function):
    """Forward and backward of `PointMLP` chunk by chunk; keeps the activations of all layers."""

    @staticmethod
    def forward(
        ctx: Any,
        point: Float[Tensor, "N A"],
        both: Float[Tensor, "T N C"] | None,
        bias: Float[Tensor, "T W"],
        point_weight: Float[Tensor, "W A"],
        both_weight: Float[Tensor, "W C"],
        *layers: Tensor,
    ) -> Float[Tensor, "T N out"]:
        times, count = len(bias), len(point)
        weights, biases = layers[::2], layers[1::2]
        output = point.new_empty(times, count, len(weights[-1]))
        activations = []
        for start, stop in _chunks(count, times):
            hidden = (point[start:stop] @ point_weight.T) + bias[:, None]
            if both is not None:
                hidden += both[:, start:stop] @ both_weight.T
            hidden = nn.functional.leaky_relu_(hidden.flatten(0, 1), SLOPE)
            kept = [hidden]
            for weight, layer_bias in zip(weights[:-1], biases[:-1], strict=True):
                hidden = nn.functional.leaky_relu_(
                    torch.addmm(layer_bias, hidden, weight.T), SLOPE
                )
                kept.append(hidden)
            last = torch.addmm(biases[-1], hidden, weights[-1].T)
            output[:, start:stop] = last.unflatten(0, (times, -1))
            activations.append(kept)
        ctx.activations = activations
        ctx.save_for_backward(point, both, bias, point_weight, both_weight, *weights)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (output_gradient,) = gradients
        point, both, bias, point_weight, both_weight, *weights = ctx.saved_tensors
        times, count = len(bias), len(point)
        need_point, need_both = ctx.needs_input_grad[:2]
        need_both = need_both and both is not None
        point_gradient = torch.empty_like(point) if need_point else None
        both_gradient = torch.empty_like(both) if need_both else None
        bias_gradient = torch.zeros_like(bias)
        point_weight_gradient = torch.zeros_like(point_weight)
        both_weight_gradient = torch.zeros_like(both_weight)
        weight_gradients = [torch.zeros_like(weight) for weight in weights]
        layer_bias_gradients = [weight.new_zeros(len(weight)) for weight in weights]
        for (start, stop), kept in zip(_chunks(count, times), ctx.activations, strict=True):
            flow = output_gradient[:, start:stop].reshape(-1, output_gradient.shape[-1])
            for layer in range(len(weights) - 1, -1, -1):
                weight_gradients[layer].addmm_(flow.T, kept[layer])
                layer_bias_gradients[layer] += flow.sum(0)
                # The sign of an activation tells which side of zero its argument was on.
                flow = torch.ops.aten.leaky_relu_backward(
                    flow @ weights[layer], kept[layer], SLOPE, True
                )
            flow = flow.unflatten(0, (times, -1))
            bias_gradient += flow.sum(1)
            if both is not None:
                flat = flow.flatten(0, 1)
                both_weight_gradient.addmm_(flat.T, both[:, start:stop].flatten(0, 1))
                if both_gradient is not None:
                    both_gradient[:, start:stop] = flow @ both_weight
            over_times = flow[0] if times == 1 else flow.sum(0)
            point_weight_gradient.addmm_(over_times.T, point[start:stop])
            if point_gradient is not None:
                torch.mm(over_times, point_weight, out=point_gradient[start:stop])
        layers = [
            gradient
            for pair in zip(weight_gradients, layer_bias_gradients, strict=True)
            for gradient in pair
        ]
        return (
            point_gradient,
            both_gradient,
            bias_gradient,
            point_weight_gradient,
            both_weight_gradient,
            *layers,
        )


def _chunks(count: int, times: int) -> list[tuple[int, int]]:
    """Equal ranges of points with about `_ROWS` rows over all times."""
    pieces = max(1, round(count * times / _ROWS))
    edges = [count * piece // pieces for piece in range(pieces + 1)]
    return list(zip(edges, edges[1:]))


def _uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    """PyTorch's default start of linear layers."""
    bound = 1 / math.sqrt(max(fan_in, 1))
    return torch.empty(shape).uniform_(-bound, bound)
