"""`render`: checks its input, picks the backend and hands over."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.cuda_support import needs, what_is_missing
from evsplat.errors import BackendError, ConfigError
from evsplat.render import cuda, native, reference
from evsplat.render.job import Backdrop, RenderJob
from evsplat.render.light import LIT_CHANNELS, MOST_LIT, lit_apart
from evsplat.render.splats import LOW_PASS, RenderOutput, Splats, split_channels

logger = logging.getLogger(__name__)

BackendName = Literal["auto", "native", "gsplat", "reference"]

_BACKENDS = {"native": native.render, "gsplat": cuda.render, "reference": reference.render}
_BACKEND_OF_DEVICE = {"cpu": "native", "cuda": "gsplat"}


def render(
    splats: Splats,
    camera: Camera,
    *,
    static: Splats | None = None,
    background: Float[Tensor, "C"] | Float[Tensor, "H W C"] | None = None,
    backend: BackendName = "auto",
    near: float = 0.01,
    low_pass: float = LOW_PASS,
    backdrop: Backdrop | None = None,
    static_light: Float[Tensor, "T H W"] | None = None,
    groups: Sequence[int] = (),
) -> RenderOutput:
    """Composite the Gaussians front to back, by the rules of gsplat 1.5 ("classic" mode).

    EWA projection with a low-pass of ``low_pass`` px^2, alpha at most 0.999, contributions under
    1/255 left out, stop before the transmittance would reach 1e-4. Gaussians nearer than ``near``
    metres or with NaN in their geometry are not drawn. Gradients go to every field of ``splats``
    and ``static``, to ``background`` and ``camera.world_to_camera``, not to ``camera.K``.

    ``static`` are more Gaussians of the same picture, the same at all times. The native backend
    projects and sorts them once, and composites tiles that no other Gaussian touches once for all
    times; gsplat projects them once. The result is that of passing them in ``splats`` at each time.

    ``backdrop`` keeps what the native backend finds of ``static`` for the next render with the same
    one, where neither ``static`` nor the camera has changed; no gradients then.

    ``static_light`` is a factor on the first three channels of what ``static`` and the background
    add to each pixel.

    ``groups`` are sizes of groups of channels, all of them, that come as pictures of each time as
    well. Gradients then go through these: ``image`` need not have any.

    ``auto`` takes ``native`` for tensors on the CPU and ``gsplat`` for those on a CUDA device. A
    backend that cannot run is a `BackendError` with the reason, never another one's work.
    """
    chosen = _chosen(backend, splats.means.device)
    splats = splats.with_times()
    times = _check_splats(splats, "")
    if static is not None:
        static = static.with_times()
        if _check_splats(static, "static.") != 1:
            raise BackendError("render: static Gaussians have no axis of times but 1.")
        _check_alike(splats, static)
    _check_camera(splats, camera, background)
    if static_light is not None:
        if static is None:
            raise BackendError("render: static_light falls on static Gaussians; there are none.")
        _check_light(static_light, splats, camera, times)
    if not low_pass > 0:
        raise BackendError(f"render: low_pass is {low_pass}, expected px^2 above 0.")
    if groups and sum(groups) != splats.channels.shape[-1]:
        raise BackendError(
            f"render: groups are {list(groups)}, together {sum(groups)}, expected "
            f"{splats.channels.shape[-1]}, the number of channels."
        )
    if backdrop is not None and torch.is_grad_enabled():
        raise BackendError("render: a backdrop has no gradients; draw within torch.no_grad().")

    job = RenderJob(
        splats, static, times, camera, background, near, low_pass, backdrop, static_light
    )
    draw = _BACKENDS[chosen]
    if static_light is not None and (chosen != "native" or _needs_gradient(background)):
        drawn = lit_apart(job, draw)
    else:
        drawn = draw(replace(job, groups=tuple(groups)))
    if groups and not drawn.groups:
        drawn = replace(drawn, groups=split_channels(drawn.image, groups))
    return drawn


def _chosen(backend: BackendName, device: torch.device) -> str:
    """The backend asked for, or for ``auto`` that of the device."""
    if backend not in get_args(BackendName):
        raise BackendError(
            f"Unknown render backend {backend!r}; choose one of {', '.join(get_args(BackendName))}."
        )
    if backend != "auto":
        return backend
    if device.type not in _BACKEND_OF_DEVICE:
        raise BackendError(
            f"No render backend for device {device}; move the tensors to the CPU or a CUDA "
            "device, or ask for backend='reference', which is slow."
        )
    return _BACKEND_OF_DEVICE[device.type]


def _needs_gradient(tensor: Tensor | None) -> bool:
    return tensor is not None and tensor.requires_grad and torch.is_grad_enabled()


def _check_splats(splats: Splats, prefix: str) -> int:
    """Refuse shapes, devices and types that do not fit together; returns the number of times."""
    means = splats.means
    if means.ndim != 3:
        raise BackendError(
            f"render: {prefix}means has shape {tuple(means.shape)}, expected (T, N, 3)."
        )
    count = means.shape[1]
    inner: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quaternions": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "channels": (count, max(1, splats.channels.shape[-1])),
        "linear": (count, 3, 3),
        "centers2d_offset": (count, 2),
    }
    values = {name: getattr(splats, name) for name in inner}
    values = {name: value for name, value in values.items() if value is not None}
    times = max(len(value) for value in values.values())
    for name, value in values.items():
        shape = inner[name]
        if tuple(value.shape[1:]) != shape or len(value) not in (1, times):
            expected = ", ".join(str(size) for size in shape)
            raise BackendError(
                f"render: {prefix}{name} has shape {tuple(value.shape)}, expected (T, {expected}) "
                f"with T = 1 or {times}."
            )
        _check_type(f"{prefix}{name}", value, means)
    return times


def _check_type(name: str, tensor: Tensor, means: Tensor) -> None:
    if not tensor.is_floating_point() or tensor.dtype != means.dtype:
        raise BackendError(f"render: {name} is {tensor.dtype}, but means is {means.dtype}.")
    if tensor.device != means.device:
        raise BackendError(f"render: {name} is on {tensor.device}, but means is on {means.device}.")


def _check_alike(splats: Splats, static: Splats) -> None:
    _check_type("static.means", static.means, splats.means)
    channels, more = splats.channels.shape[-1], static.channels.shape[-1]
    if channels != more:
        raise BackendError(f"render: static has {more} channels, but splats has {channels}.")


def _check_camera(splats: Splats, camera: Camera, background: Tensor | None) -> None:
    width, height, channels = camera.width, camera.height, splats.channels.shape[-1]
    if width < 1 or height < 1:
        raise BackendError(f"render: the camera's image is {width} x {height} pixels.")
    if background is not None:
        if tuple(background.shape) not in ((channels,), (height, width, channels)):
            raise BackendError(
                f"render: background has shape {tuple(background.shape)}, "
                f"expected ({channels},) or ({height}, {width}, {channels})."
            )
        _check_type("background", background, splats.means)
    K = camera.K.detach()
    if tuple(K.shape) != (3, 3) or tuple(camera.world_to_camera.shape) != (4, 4):
        raise BackendError("render: the camera needs a (3, 3) K and a (4, 4) world_to_camera.")
    rows = K.tolist()
    if rows[0][1] != 0 or rows[1][0] != 0 or rows[2] != [0, 0, 1]:
        raise BackendError(f"render: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], not {rows}.")
    if not (rows[0][0] > 0 and rows[1][1] > 0):
        raise BackendError(f"render: the focal lengths in K must be positive, not {rows}.")


def _check_light(light: Tensor, splats: Splats, camera: Camera, times: int) -> None:
    shape = (times, camera.height, camera.width)
    if tuple(light.shape) != shape:
        raise BackendError(
            f"render: static_light has shape {tuple(light.shape)}, expected {shape}."
        )
    _check_type("static_light", light, splats.means)
    if not LIT_CHANNELS <= splats.channels.shape[-1] <= MOST_LIT:
        raise BackendError(
            f"render: static_light needs {LIT_CHANNELS} to {MOST_LIT} channels, not "
            f"{splats.channels.shape[-1]}."
        )


def choose_device(asked: str) -> str:
    """``cpu`` or ``cuda`` for what was asked for; what cannot run is an error with the reason.

    ``auto`` is ``cuda`` where an NVIDIA GPU, its driver, PyTorch with CUDA, gsplat and the means to
    build its kernels are all there, otherwise ``cpu``; which one it is, is logged once.

    Raises:
        ConfigError: none of ``auto``, ``cpu`` and ``cuda``.
        BackendError: ``cuda`` is asked for and cannot run.
    """
    if asked not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device {asked}: expected auto, cpu or cuda.")
    if asked == "cpu":
        return asked
    missing = what_is_missing()
    if asked == "cuda":
        if missing is not None:
            raise BackendError(f"--device cuda: {missing} Or compute with --device cpu.")
        return asked
    device = "cuda" if missing is None else "cpu"
    # Where there is no NVIDIA GPU at all, nobody misses the rest.
    worth_telling = missing is not None and next(needs()).there
    _tell_once(f"{device}. For CUDA: {missing}" if worth_telling else device)
    return device


@cache
def _tell_once(device: str) -> None:
    logger.info("device: %s", device)
