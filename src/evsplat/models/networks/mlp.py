"""A leaky-ReLU MLP for many points at several times, near the speed of its matrix products.

The first layer is split by what its inputs depend on, so that nothing is repeated: inputs per point
(an encoding), per time (a pose, given as the finished bias) and per point and time (a direction).
In float32 on the CPU the compiled module takes blocks of points through all layers, forward and
back, while they are in the cache; everywhere else plain torch does the same.

On processors with AMX the module multiplies on tiles, where each float is the sum of two bfloat16:
values and gradients are those of float32 to 1e-5 (relative, by norm) in place of 1e-7. The
environment variable EVSPLAT_ISA=avx512 asks for float32 there.
"""

import math
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native

SLOPE = 0.01
"""Of the leaky ReLU, as 3DGS-Avatar."""


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
        self.point_weight = nn.Parameter(uniform((width, per_point), fan_in))
        self.time_weight = nn.Parameter(uniform((width, per_time), fan_in))
        self.both_weight = nn.Parameter(uniform((width, per_both), fan_in))
        self.first_bias = nn.Parameter(uniform((width,), fan_in))
        sizes = [width] * depth + [out]
        self.weights = nn.ParameterList(uniform((o, i), i) for i, o in pairwise(sizes))
        self.biases = nn.ParameterList(uniform((o,), i) for i, o in pairwise(sizes))
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
        inputs = (point, both, bias, self.point_weight, self.both_weight, *layers)
        if runs_native(point):
            keep = torch.is_grad_enabled() and any(
                tensor is not None and tensor.requires_grad for tensor in inputs
            )
            output: Tensor = _NativeMLP.apply(keep, *inputs)
            return output
        return plain_mlp(*inputs)


def plain_mlp(
    point: Float[Tensor, "N A"],
    both: Float[Tensor, "T N C"] | None,
    bias: Float[Tensor, "T W"],
    point_weight: Float[Tensor, "W A"],
    both_weight: Float[Tensor, "W C"],
    *layers: Tensor,
) -> Float[Tensor, "T N out"]:
    """The network in plain torch, on any device and in any precision.

    ``bias`` is the first layer's, ``layers`` are weight and bias of each later layer.
    """
    if len(bias) == 1:
        hidden = nn.functional.linear(point, point_weight, bias[0])[None]
    else:
        hidden = (point @ point_weight.T) + bias[:, None]
    if both is not None:
        hidden = hidden + both @ both_weight.T
    for weight, layer_bias in zip(layers[::2], layers[1::2], strict=True):
        hidden = nn.functional.linear(nn.functional.leaky_relu(hidden, SLOPE), weight, layer_bias)
    return hidden


class _NativeMLP(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, keep: bool, point: Tensor, both: Tensor | None, *parameters: Tensor
    ) -> Float[Tensor, "T N out"]:
        points, (bias, point_weight, both_weight, *layers) = _plain(point), map(_plain, parameters)
        moving = None if both is None else _plain(both)
        threads = torch.get_num_threads()
        ctx.job = native.Mlp(
            points, moving, bias, point_weight, both_weight, layers, SLOPE, keep, threads
        )
        output = torch.empty(len(bias), len(points), len(layers[-1]))
        ctx.job.forward(output)
        ctx.save_for_backward(point, both, *parameters)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        # Reading saved_tensors also refuses inputs that were changed in place since.
        inputs = [
            None if tensor is None else torch.empty(tensor.shape) for tensor in ctx.saved_tensors
        ]
        point, both, bias, point_weight, both_weight, *layers = inputs
        point, both = (
            gradient if needed else None
            for gradient, needed in zip((point, both), ctx.needs_input_grad[1:3], strict=True)
        )
        upstream = gradients[0].contiguous()
        ctx.job.backward(upstream, point, both, bias, point_weight, both_weight, layers)
        return None, point, both, bias, point_weight, both_weight, *layers


def _plain(tensor: Tensor) -> Tensor:
    """Contiguous and without gradient, as the module takes it."""
    return tensor.detach().contiguous()


def uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    """PyTorch's default start of linear layers."""
    bound = 1 / math.sqrt(max(fan_in, 1))
    return torch.empty(shape).uniform_(-bound, bound)
