"""The compiled CPU backend: float32, any number of times and channels, gradients in C++."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import import_error, native, runs_native
from evsplat.errors import BackendError
from evsplat.render.splats import PinholeCamera, RenderOutput, Splats


def render(
    splats: Splats,
    camera: PinholeCamera,
    background: Tensor | None,
    offset: Tensor | None,
    near: float,
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
    image, alpha, radii = _Rasterize.apply(
        means, splats.quats, splats.scales, splats.opacities, splats.channels, splats.linear,
        offset, background, camera.world_to_camera, camera.K, camera.width, camera.height, near,
    )  # fmt: skip
    return RenderOutput(image, alpha, radii)


def _plain(tensor: Tensor) -> Tensor:
    """Contiguous float32 without gradient, as the module takes it."""
    return tensor.detach().to("cpu", torch.float32).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        *fields, pose, K, width, height, near = inputs
        means, quats, scales, opacities, values = (_plain(f) for f in fields[:5])
        linear, offset, background = (None if f is None else _plain(f) for f in fields[5:])
        times = max(f.shape[0] for f in fields[:-1] if f is not None)
        count, channels = means.shape[1], values.shape[2]
        try:
            job = native.Render(
                width, height, _plain(K), _plain(pose), near, means, quats, scales, opacities,
                values, linear, offset, background, times, torch.get_num_threads(),
            )  # fmt: skip
            image = torch.empty(times, channels, height, width, dtype=torch.float32)
            alpha = torch.empty(times, height, width, dtype=torch.float32)
            radii = torch.empty(times, count, dtype=torch.int32)
            job.forward(image, alpha, radii)
        except (RuntimeError, ValueError) as error:
            raise BackendError(f"The native render backend failed: {error}.") from error
        # Planar in memory, which is what the kernels and convolutions like.
        image = image.permute(0, 2, 3, 1)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.job = job
        ctx.save_for_backward(*fields, pose)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image_grad: Tensor | None, alpha_grad: Tensor | None, _: None) -> Any:
        # Reading saved_tensors also refuses inputs that were changed in place since.
        *fields, pose = ctx.saved_tensors
        if image_grad is None and alpha_grad is None:
            return (None,) * 13
        needed = ctx.needs_input_grad
        grads = [
            torch.zeros(f.shape, dtype=torch.float32) if f is not None and need else None
            for f, need in zip(fields, needed, strict=False)
        ]
        view = torch.zeros(12, dtype=torch.float32) if needed[8] else None
        *gaussians, background = grads
        ctx.job.backward(image_grad, alpha_grad, *gaussians, view, background)
        pose_grad = None
        if view is not None:
            pose_grad = torch.zeros(4, 4, dtype=torch.float32)
            pose_grad[:3, :3] = view[:9].view(3, 3)
            pose_grad[:3, 3] = view[9:]
            pose_grad = pose_grad.to(pose.dtype)
        return *grads, pose_grad, None, None, None, None
