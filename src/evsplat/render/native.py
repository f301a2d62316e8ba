"""The compiled CPU backend: float32, any number of times and channels, gradients in C++."""

from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.camera import Camera
from evsplat.compiled import import_error, native, runs_native
from evsplat.errors import BackendError
from evsplat.render.job import RenderJob
from evsplat.render.splats import RenderOutput, Splats, by_group, pictures_of


def render(job: RenderJob) -> RenderOutput:
    """Draw with the native kernels."""
    if native is None:
        raise BackendError(
            f"The native render backend is not built ({import_error}); install evsplat with pip, "
            "or ask for backend='reference', which is slow."
        )
    means = job.splats.means
    if not runs_native(means):
        raise BackendError(
            f"The native render backend needs float32 tensors on the CPU, not {means.dtype} on "
            f"{means.device}; convert them, or ask for backend='reference'."
        )
    if job.backdrop is not None and job.static is not None:
        job.backdrop.show(job)
    layers = (*_fields(job.splats), *_fields(job.static))
    behind = job.background, job.static_light
    drawn = _Rasterize.apply(job, job.camera.world_to_camera, *behind, *layers)
    image, alpha, radii, static_radii, *pictures = drawn
    return RenderOutput(image, alpha, radii, static_radii, by_group(pictures, job.times))


def rows_in_view(
    means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], *cameras: Camera
) -> Int[Tensor, " V"] | None:
    """Rows that may reach into a picture, whatever their rotation and opacity; None for all.

    Where the compiled module does not run it is None as well: a GPU would have to be waited for.
    No row is left out that `render` draws (with its default ``near``) for any of the ``cameras``.
    """
    if not (runs_native(means) and runs_native(scales)):
        return None
    places, sizes = means.detach().contiguous(), scales.detach().contiguous()
    found: list[Tensor] = []
    for camera in cameras:
        rows = torch.empty(len(means), dtype=torch.int64)
        count = native.rows_in_view(
            places,
            sizes,
            camera.K.detach().float().contiguous(),
            camera.world_to_camera.detach().float().contiguous(),
            camera.width,
            camera.height,
            rows,
        )
        if count == len(means):
            return None
        found.append(rows[:count])
    return found[0] if len(found) == 1 else torch.cat(found).unique()


_FIELDS = len(fields(Splats))


def _fields(splats: Splats | None) -> list[Tensor | None]:
    """The fields in their order, as the module takes them."""
    return [None if splats is None else getattr(splats, f.name) for f in fields(Splats)]


def _plain(tensor: Tensor | None) -> Tensor | None:
    """Contiguous float32 without gradient, as the module takes it."""
    return None if tensor is None else tensor.detach().to("cpu", torch.float32).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, job: RenderJob, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        camera, times = job.camera, job.times
        backdrop = None if job.static is None else job.backdrop
        pose, background, light, *layers = map(_plain, inputs)
        moving, static = layers[:_FIELDS], layers[_FIELDS:]
        means, channels = moving[0], moving[4]
        assert means is not None and channels is not None
        static_count = 0 if static[0] is None else static[0].shape[1]
        try:
            kept = native.Render(
                camera.width, camera.height, _plain(camera.K), pose, job.near, job.low_pass, moving,
                static if static_count else [], background, light, times,
                torch.get_num_threads(),
            )  # fmt: skip
            image = torch.empty(times, channels.shape[2], camera.height, camera.width)
            alpha = torch.empty(times, camera.height, camera.width)
            radii = torch.empty(times, means.shape[1], dtype=torch.int32)
            static_radii = torch.empty(1, static_count, dtype=torch.int32)
            earlier = None if backdrop is None else backdrop.kept
            kept.forward(image, alpha, radii, static_radii, backdrop is not None, earlier)
            if backdrop is not None:
                backdrop.kept = kept
        except (RuntimeError, ValueError) as error:
            raise BackendError(f"The native render backend failed: {error}.") from error
        # Planar in memory, which is what the kernels and convolutions like.
        image = image.permute(0, 2, 3, 1)
        ctx.set_materialize_grads(False)
        pictures = pictures_of(image, job.groups) if job.groups else ()
        # Gradients of pictures are read where they are: to put them into one of the image first
        # takes as long as many a loss.
        ctx.groups = job.groups or (channels.shape[2],)
        ctx.mark_non_differentiable(radii, static_radii, *([image] if pictures else []))
        ctx.kept = kept
        ctx.save_for_backward(*inputs)
        return image, alpha, radii, static_radii, *pictures

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:
        # Reading saved_tensors also refuses inputs that were changed in place since.
        inputs, needed = ctx.saved_tensors, ctx.needs_input_grad[1:]
        image_grad, alpha_grad, _, _, *above = upstream
        if image_grad is not None:
            above = list(image_grad)
        if alpha_grad is None and all(gradient is None for gradient in above):
            return (None,) * (1 + len(inputs))
        groups = ctx.groups if above else ()
        _, background, light, *layers = [
            torch.zeros(tensor.shape) if tensor is not None and need else None
            for tensor, need in zip(inputs, needed, strict=True)
        ]
        view = torch.zeros(12) if needed[0] else None
        moving, static = layers[:_FIELDS], layers[_FIELDS:]
        ctx.kept.backward(above, groups, alpha_grad, moving, static, view, background, light)
        pose = None
        if view is not None:
            pose = torch.zeros(4, 4)
            pose[:3, :3] = view[:9].view(3, 3)
            pose[:3, 3] = view[9:]
            pose = pose.to(inputs[0].dtype)
        return None, pose, background, light, *layers
