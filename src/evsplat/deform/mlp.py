"""A leaky-ReLU MLP for many points at several times, near the speed of its matrix products.

The first layer is split by what its inputs depend on, so that nothing is repeated: inputs per point
(an encoding), per time (a pose, given as the finished bias) and per point and time (a direction).
Points go through all layers in chunks whose activations stay in the processor's cache.
"""

import math
from itertools import pairwise
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

SLOPE = 0.01
"""Of the leaky ReLU, as 3DGS-Avatar."""
_ROWS = 2048
"""Rows (points x times) per chunk and thread: an activation of width 128 fills 1 MB."""
Precision = Literal["float32", "bfloat16"]


class PointMLP(nn.Module):
    """Linear and leaky-ReLU layers over points and times; linear at the end.

    Weights start as PyTorch's linear layers do, except that ``last_std`` (if given) draws those of
    the last layer from N(0, last_std^2) with zero bias, so that the output starts near zero.
    ``precision`` "bfloat16" computes the products between hidden layers, forward and backward, in
    bfloat16 (first and last layer, weights and their gradients stay in float32): almost twice as
    fast on processors with AVX-512 BF16 or AMX, slower on others. Outputs then err by about 0.3 %,
    gradients by up to 8 % of their norm (where rounding moves a leaky ReLU's argument across zero).
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
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision is '{precision}', expected float32 or bfloat16")
        self.hidden_dtype = torch.bfloat16 if precision == "bfloat16" else None
        fan_in = per_point + per_time + per_both
        self.point_weight = nn.Parameter(_uniform((width, per_point), fan_in))
        self.time_weight = nn.Parameter(_uniform((width, per_time), fan_in))
        self.both_weight = nn.Parameter(_uniform((width, per_both), fan_in))
        self.first_bias = nn.Parameter(_uniform((width,), fan_in))
        sizes = [width] * depth + [out]
        self.weights = nn.ParameterList(_uniform((o, i), i) for i, o in pairwise(sizes))
        self.biases = nn.ParameterList(_uniform((o,), i) for i, o in pairwise(sizes))
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
            point, both, bias, self.point_weight, self.both_weight, self.hidden_dtype, *layers
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
        hidden_dtype: torch.dtype | None,
        *layers: Tensor,
    ) -> Float[Tensor, "T N out"]:
        times, count = len(bias), len(point)
        weights, biases = layers[::2], layers[1::2]
        low = hidden_dtype or point.dtype
        inner = [(w.to(low), b.to(low)) for w, b in zip(weights[:-1], biases[:-1], strict=True)]
        output = point.new_empty(times, count, len(weights[-1]))
        activations = []
        chunks = _chunks(count, times)
        for start, stop in chunks:
            hidden = (point[start:stop] @ point_weight.T) + bias[:, None]
            if both is not None:
                hidden += both[:, start:stop] @ both_weight.T
            hidden = nn.functional.leaky_relu_(hidden.flatten(0, 1), SLOPE).to(low)
            kept = [hidden]
            for weight, layer_bias in inner:
                hidden = nn.functional.leaky_relu_(torch.addmm(layer_bias, hidden, weight.T), SLOPE)
                kept.append(hidden)
            last = torch.addmm(biases[-1], hidden.to(point.dtype), weights[-1].T)
            output[:, start:stop] = last.unflatten(0, (times, -1))
            activations.append(kept)
        ctx.chunks, ctx.activations = chunks, activations
        ctx.save_for_backward(point, both, bias, point_weight, both_weight, *weights)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (output_gradient,) = gradients
        point, both, bias, point_weight, both_weight, *weights = ctx.saved_tensors
        times = len(bias)
        need_point, need_both = ctx.needs_input_grad[:2]
        need_both = need_both and both is not None
        point_gradient = torch.empty_like(point) if need_point else None
        both_gradient = torch.empty_like(both) if need_both else None
        bias_gradient = torch.zeros_like(bias)
        point_weight_gradient = torch.zeros_like(point_weight)
        both_weight_gradient = torch.zeros_like(both_weight)
        weight_gradients = [torch.zeros_like(weight) for weight in weights]
        layer_bias_gradients = [weight.new_zeros(len(weight)) for weight in weights]
        full, low = point.dtype, ctx.activations[0][0].dtype
        inner = [weight.to(low) for weight in weights[:-1]]
        for (start, stop), kept in zip(ctx.chunks, ctx.activations, strict=True):
            flow = output_gradient[:, start:stop].reshape(-1, output_gradient.shape[-1])
            weight_gradients[-1].addmm_(flow.T, kept[-1].to(full))
            layer_bias_gradients[-1] += flow.sum(0)
            flow = _through_leaky((flow @ weights[-1]).to(low), kept[-1])
            for layer in range(len(inner) - 1, -1, -1):
                weight_gradients[layer] += flow.T @ kept[layer]
                layer_bias_gradients[layer] += flow.sum(0, dtype=full)
                flow = _through_leaky(flow @ inner[layer], kept[layer])
            flow = flow.to(full)
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
            None,
            *layers,
        )


def _through_leaky(gradient: Tensor, activation: Tensor) -> Tensor:
    """Gradient before the leaky ReLU: an activation's sign tells where its argument was."""
    result: Tensor = torch.ops.aten.leaky_relu_backward(gradient, activation, SLOPE, True)
    return result


def _chunks(count: int, times: int) -> list[tuple[int, int]]:
    """Equal ranges of points with about `_ROWS` rows per thread over all times."""
    pieces = max(1, round(count * times / (_ROWS * torch.get_num_threads())))
    edges = [count * piece // pieces for piece in range(pieces + 1)]
    return list(pairwise(edges))


def _uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    """PyTorch's default start of linear layers."""
    bound = 1 / math.sqrt(max(fan_in, 1))
    return torch.empty(shape).uniform_(-bound, bound)
