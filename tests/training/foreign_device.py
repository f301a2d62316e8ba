"""A device that is not the CPU and not there: finds what would fail or wait on a GPU.

Tensors on it are PyTorch's fake ones: they have shapes and a device, but no data. An operation on
tensors of two devices, and one that needs the data on the host (``.item()``, ``nonzero``, indexing
with a mask), raises; a copy between host and device for which the host waits raises here.
"""

from types import SimpleNamespace

import torch
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensor,
    FakeTensorMode,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

NAME = "lazy"  # a device type that CPU builds of PyTorch know and never use
NEEDS_DATA = (DataDependentOutputException, DynamicOutputShapeException)
COPIES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class HostWaits(AssertionError):
    """The host would wait for the device."""


class ForeignDevice(TorchDispatchMode):
    """While it is entered, `NAME` is a device; the CPU works as always."""

    def __init__(self):
        super().__init__()
        self.fake = FakeTensorMode(allow_non_fake_inputs=True)
        self.may_wait = True

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        leaves = tree_leaves((args, kwargs))
        target = kwargs.get("device")
        there = target is not None and torch.device(target).type == NAME
        if not there and not any(isinstance(leaf, FakeTensor) for leaf in leaves):
            return func(*args, **kwargs)
        if func in COPIES and not self.may_wait:
            devices = {leaf.device.type for leaf in leaves if isinstance(leaf, torch.Tensor)}
            if target is not None:
                devices.add(torch.device(target).type)
            waits = not kwargs.get("non_blocking") and not (len(args) > 2 and args[2])
            scalar = func is COPIES[1] and args[1].ndim == 0  # travels with the launch
            if len(devices) > 1 and waits and not scalar:
                raise HostWaits(f"{func} between {devices}, which the host waits for")
        with self.fake:
            return func(*args, **kwargs)


class Descent(torch.optim.SGD):
    """In place of PyTorch's fused Adam, which refuses the device."""

    def __init__(self, groups, **_):
        super().__init__(groups, lr=0.1)
        self.found_inf = 0.0

    @torch.no_grad()
    def step(self):
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter.sub_(0.1 * (1 - self.found_inf) * parameter.grad)


def drawing(width, height):
    """gsplat's four functions as shapes that depend on all their inputs."""

    def project(means, covars, quats, scales, views, Ks, *size, opacities, **rules):
        shape = covars if covars is not None else quats.sum(-1, keepdim=True) + scales
        flat = means + views[:, 0, :3, 3].unsqueeze(1) + Ks[:, 0, 0].unsqueeze(1)
        radii = (opacities[..., None] > 0).expand(*means.shape[:2], 2).int()
        values = (radii, flat[..., :2], flat[..., 2], shape[..., :3])
        return (*(value.unsqueeze(1) for value in values), None)

    def tiles(centers, radii, depths, size, across, down):
        pairs = torch.zeros(100, dtype=torch.int64, device=centers.device)
        return radii, pairs, pairs.int()

    def offsets(pairs, times, across, down):
        return torch.zeros(times, down, across, dtype=torch.int32, device=pairs.device)

    def composite(centers, conics, colours, opacities, wide, high, size, starts, order):
        assert (wide, high) == (width, height)
        light = opacities * (centers.sum(-1) + conics.sum(-1))
        colour = (light[..., None] * colours).sum(1)[:, None, None]
        alpha = light.sum(1)[:, None, None, None]
        return colour.expand(-1, high, wide, -1), alpha.expand(-1, high, wide, 1)

    return SimpleNamespace(
        fully_fused_projection=project,
        isect_tiles=tiles,
        isect_offset_encode=offsets,
        rasterize_to_pixels=composite,
    )
