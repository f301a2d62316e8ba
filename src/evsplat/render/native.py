"""The compiled CPU backend: float32, any number of times and channels, gradients in C++."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import import_error, native, runs_native
from evsplat.errors import BackendError
from evsplat.render.backdrop import Backdrop
from evsplat.render.splats import PinholeCamera, RenderOutput, Splats


def render(
    splats: Splats,
    static: Splats | None,
    times: int,
    camera: PinholeCamera,
    background: Tensor | None,
    near: float,
    low_pass: float,
    backdrop: Backdrop | None,
) -> RenderOutput:
    """Draw with the native kernels; fields have their leading axis of times."""
    if native is None:
        raise BackendError(
            f"The native render backend is not built ({import_error}); install evsplat with pip, "
            "or ask for backend='reference', which is slow."
        )
    means = splats.means
    if not runs_native(means):
        raise BackendError(
            f"The native render backend needs float32 tensors on the CPU, not {means.dtype} on "
            f"{means.device}; convert them, or ask for backend='reference'."
        )
    if static is None:
        backdrop = None
    if backdrop is not None and static is not None:
        backdrop.show(splats, static, camera, background, near, low_pass)
    image, alpha, radii, static_radii = _Rasterize.apply(
        backdrop, times, camera.width, camera.height, camera.K, near,
        low_pass, camera.world_to_camera, background, *_fields(splats), *_fields(static),
    )  # fmt: skip
    return RenderOutput(image, alpha, radii, static_radii)


_FIELDS = len(fields(Splats))
_SETTINGS = 7
"""Inputs of `_Rasterize` before those that may have a gradient."""


def _fields(splats: Splats | None) -> list[Tensor | None]:
    """The fields in their order, as the module takes them."""
    return [None if splats is None else getattr(splats, f.name) for f in fields(Splats)]


def _plain(tensor: Tensor | None) -> Tensor | None:
    """Contiguous float32 without gradient, as the module takes it."""
    return None if tensor is None else tensor.detach().to("cpu", torch.float32).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        backdrop: Backdrop | None,
        times: int,
        width: int,
        height: int,
        K: Tensor,
        near: float,
        low_pass: float,
        *inputs: Any,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        pose, background, *layers = map(_plain, inputs)
        moving, still = layers[:_FIELDS], layers[_FIELDS:]
        means, channels = moving[0], moving[4]
        assert means is not None and channels is not None
        still_count = 0 if still[0] is None else still[0].shape[1]
        try:
            job = native.Render(
                width, height, _plain(K), pose, near, low_pass, moving,
                still if still_count else [], background, times, torch.get_num_threads(),
            )  # fmt: skip
            image = torch.empty(times, channels.shape[2], height, width)
            alpha = torch.empty(times, height, width)
            radii = torch.empty(times, means.shape[1], dtype=torch.int32)
            still_radii = torch.empty(1, still_count, dtype=torch.int32)
            earlier = None if backdrop is None else backdrop.job
            job.forward(image, alpha, radii, still_radii, backdrop is not None, earlier)
            if backdrop is not None:
                backdrop.job = job
        except (RuntimeError, ValueError) as error:
            raise BackendError(f"The native render backend failed: {error}.") from error
        # Planar in memory, which is what the kernels and convolutions like.
        image = image.permute(0, 2, 3, 1)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, still_radii)
        ctx.job = job
        ctx.save_for_backward(*inputs)
        return image, alpha, radii, still_radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:
        # Reading saved_tensors also refuses inputs that were changed in place since.
        inputs, needed = ctx.saved_tensors, ctx.needs_input_grad[_SETTINGS:]
        image_grad, alpha_grad, *_ = upstream
        if image_grad is None and alpha_grad is None:
            return (None,) * (_SETTINGS + len(inputs))
        _, background, *layers = [
            torch.zeros(tensor.shape) if tensor is not None and need else None
            for tensor, need in zip(inputs, needed, strict=True)
        ]
        view = torch.zeros(12) if needed[0] else None
        moving, still = layers[:_FIELDS], layers[_FIELDS:]
        ctx.job.backward(image_grad, alpha_grad, moving, still, view, background)
        pose = None
        if view is not None:
            pose = torch.zeros(4, 4)
            pose[:3, :3] = view[:9].view(3, 3)
            pose[:3, 3] = view[9:]
            pose = pose.to(inputs[0].dtype)
        return *(None,) * _SETTINGS, pose, background, *layers
