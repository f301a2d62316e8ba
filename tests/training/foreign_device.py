"""A device that is not the CPU and not there: finds what would fail or wait on a GPU.

Tensors on it are PyTorch's fake ones: they have shapes and a device, but no data. An operation on
tensors of two devices, and one that needs the data on the host (``.item()``, ``nonzero``, indexing
with a mask), raises; a copy between host and device for which the host waits raises here. What a
GPU would launch is counted.
"""

from contextlib import contextmanager
from functools import partial
from importlib import import_module
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

from evsplat import devices
from evsplat.render import api, cuda

NAME = "lazy"  # a device type that CPU builds of PyTorch know and never use
NEEDS_DATA = (DataDependentOutputException, DynamicOutputShapeException)
COPIES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
DEVICE_OF = torch.ops.prim.device.default
IS_SET_TO = torch.ops.aten.is_set_to.default
_IDLE = {"empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided", "_unsafe_view"}
"""Operations that are no views and yet launch nothing."""


class HostWaits(AssertionError):
    """The host would wait for the device."""


class ForeignDevice(TorchDispatchMode):
    """While it is entered, `NAME` is a device; the CPU works as always."""

    def __init__(self):
        super().__init__()
        self.fake = FakeTensorMode(allow_non_fake_inputs=True)
        devices.kept_constant.cache_clear()  # they are of another mode
        self.may_wait = True
        self.launches = 0
        """Operations so far that make a GPU work: all but views and memory that is only taken."""
        self.counting = True

    @contextmanager
    def uncounted(self):
        """What runs within is no launch."""
        self.counting = False
        try:
            yield
        finally:
            self.counting = True

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is DEVICE_OF and isinstance(args[0], FakeTensor):
            return args[0].fake_device  # half of all calls
        if func is IS_SET_TO:  # fake ones do not know it, and a GPU is not asked
            return _is_set_to(*args)
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
        name = func._schema.name.removeprefix("aten::")
        if self.counting and func.namespace == "aten" and not func.is_view and name not in _IDLE:
            self.launches += 1
        with self.fake:
            return func(*args, **kwargs)


def _is_set_to(one, other):
    places = [(t.untyped_storage()._cdata, t.storage_offset(), t.stride()) for t in (one, other)]
    return one.shape == other.shape and places[0] == places[1]


class _Kernel(torch.autograd.Function):
    """One of gsplat's functions as shapes: nothing that it does is a launch of ours."""

    @staticmethod
    def forward(ctx, device, call, keywords, *given):
        ctx.set_materialize_grads(False)
        ctx.device, ctx.given = device, given
        with device.uncounted():
            results = call(*given, **keywords)
        if isinstance(results, torch.Tensor):
            return results
        whole = (r for r in results if r is not None and not r.is_floating_point())
        ctx.mark_non_differentiable(*whole)
        return results

    @staticmethod
    def backward(ctx, *upstream):
        needed = zip(ctx.given, ctx.needs_input_grad[3:], strict=True)
        with ctx.device.uncounted():
            return None, None, None, *(torch.zeros_like(v) if n else None for v, n in needed)


def as_on_a_gpu(device, monkeypatch, width, height):
    """Let render draw on the device, at one size, and optimisers take it for a GPU."""
    kernels = {
        name: partial(_Kernel.apply, device, call)
        for name, call in vars(drawing(width, height)).items()
    }
    gsplat = SimpleNamespace(
        **{name: lambda *g, run=run, **k: run(k, *g) for name, run in kernels.items()}
    )
    backends = api._BACKENDS | {"gsplat": lambda job: cuda.draw(gsplat, job)}
    monkeypatch.setattr(api, "_BACKENDS", backends)
    monkeypatch.setattr(api, "_BACKEND_OF_DEVICE", {NAME: "gsplat"})
    for user, kind in (("optim.optimizer", "fused"), ("utils._foreach_utils", "foreach")):
        name = f"_get_{kind}_kernels_supported_devices"
        monkeypatch.setattr(import_module(f"torch.{user}"), name, lambda: ["cpu", NAME])
    monkeypatch.setattr(torch.__future__, "get_overwrite_module_params_on_conversion", lambda: True)


class Here:
    """In place of `DeviceCache`, whose thread does not know the device."""

    def __init__(self):
        self.device, self.data = torch.device(NAME), {}

    def prefetch(self, key, make):
        self.get(key, make)

    def get(self, key, make):
        if key not in self.data:
            self.data[key] = make().to(NAME, non_blocking=True)
        return self.data[key]


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

    def composite(
        centers, conics, colours, opacities, wide, high, size, starts, order, *, masks, packed
    ):
        assert (wide, high) == (width, height) and packed
        assert masks is None or masks.shape == starts.shape
        light = opacities * (centers.sum(-1) + conics.sum(-1))
        shape = (len(starts), high, wide, -1)
        colour = (light[:, None] * colours).sum(0)
        return colour.expand(shape), light.sum().expand(len(starts), high, wide, 1)

    return SimpleNamespace(
        fully_fused_projection=project,
        isect_tiles=tiles,
        isect_offset_encode=offsets,
        rasterize_to_pixels=composite,
    )
