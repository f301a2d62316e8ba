"""`render`: checks its input, picks the backend and hands over."""

from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor

from evsplat.errors import BackendError, ConfigError
from evsplat.render import native, reference
from evsplat.render.splats import PinholeCamera, RenderOutput, Splats

BackendName = Literal["auto", "native", "reference"]


def render(
    splats: Splats,
    camera: PinholeCamera,
    *,
    background: Float[Tensor, "C"] | Float[Tensor, "H W C"] | None = None,
    centers2d_offset: Float[Tensor, "T N 2"] | None = None,
    backend: BackendName = "auto",
    near: float = 0.01,
) -> RenderOutput:
    """Composite the Gaussians front to back, by the rules of gsplat 1.5 ("classic" mode).

    EWA projection with a low-pass of 0.3 px^2, alpha at most 0.999, contributions under 1/255
    left out, stop before the transmittance would reach 1e-4. Gaussians nearer than ``near`` metres
    or with NaN in their geometry are not drawn. Gradients go to every field of ``splats``, to
    ``background``, ``camera.world_to_camera`` and ``centers2d_offset`` (added to the projected
    centres, pixels), not to ``camera.K``.
    """
    if backend not in get_args(BackendName):
        raise BackendError(
            f"Unknown render backend {backend!r}; choose one of {', '.join(get_args(BackendName))}."
        )
    fields = _with_times(splats)
    _check(fields, camera, background, centers2d_offset)
    if centers2d_offset is not None and centers2d_offset.ndim == 2:
        centers2d_offset = centers2d_offset[None]

    device = splats.means.device
    if backend == "auto" and device.type != "cpu":
        raise BackendError(
            f"No render backend for device {device} in this version; move the tensors to the CPU, "
            "or ask for backend='reference', which is slow."
        )
    if backend == "reference":
        return reference.render(fields, camera, background, centers2d_offset, near)
    return native.render(fields, camera, background, centers2d_offset, near)


def _with_times(splats: Splats) -> Splats:
    """Add the leading axis of times where it was left out."""

    def lead(value: Tensor | None, ndim: int) -> Tensor | None:
        return value[None] if value is not None and value.ndim == ndim - 1 else value

    return Splats(
        means=lead(splats.means, 3),  # type: ignore[arg-type]
        quats=lead(splats.quats, 3),  # type: ignore[arg-type]
        scales=lead(splats.scales, 3),  # type: ignore[arg-type]
        opacities=lead(splats.opacities, 2),  # type: ignore[arg-type]
        channels=lead(splats.channels, 3),  # type: ignore[arg-type]
        linear=lead(splats.linear, 4),
    )


def _check(
    splats: Splats, camera: PinholeCamera, background: Tensor | None, offset: Tensor | None
) -> None:
    """Refuse shapes, devices and types that do not fit together, naming the field."""
    means = splats.means
    if means.ndim != 3:
        raise BackendError(f"render: means has shape {tuple(means.shape)}, expected (T, N, 3).")
    count = means.shape[1]
    inner: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {
        "means": (means, (count, 3)),
        "quats": (splats.quats, (count, 4)),
        "scales": (splats.scales, (count, 3)),
        "opacities": (splats.opacities, (count,)),
        "channels": (splats.channels, (count, max(1, splats.channels.shape[-1]))),
        "linear": (splats.linear, (count, 3, 3)),
        "centers2d_offset": (
            offset[None] if offset is not None and offset.ndim == 2 else offset,
            (count, 2),
        ),
    }
    times = max(value.shape[0] for value, _ in inner.values() if value is not None)
    for name, (value, shape) in inner.items():
        if value is None:
            continue
        if tuple(value.shape[1:]) != shape or value.shape[0] not in (1, times):
            expected = ", ".join(str(size) for size in shape)
            raise BackendError(
                f"render: {name} has shape {tuple(value.shape)}, expected (T, {expected}) "
                f"with T = 1 or {times}."
            )
    width, height, channels = camera.width, camera.height, splats.channels.shape[-1]
    if width < 1 or height < 1:
        raise BackendError(f"render: the camera's image is {width} x {height} pixels.")
    if background is not None and tuple(background.shape) not in (
        (channels,),
        (height, width, channels),
    ):
        raise BackendError(
            f"render: background has shape {tuple(background.shape)}, "
            f"expected ({channels},) or ({height}, {width}, {channels})."
        )
    tensors = {name: value for name, (value, _) in inner.items()} | {"background": background}
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if not tensor.is_floating_point() or tensor.dtype != means.dtype:
            raise BackendError(f"render: {name} is {tensor.dtype}, but means is {means.dtype}.")
        if tensor.device != means.device:
            raise BackendError(
                f"render: {name} is on {tensor.device}, but means is on {means.device}."
            )
    K = camera.K.detach()
    if tuple(K.shape) != (3, 3) or tuple(camera.world_to_camera.shape) != (4, 4):
        raise BackendError("render: the camera needs a (3, 3) K and a (4, 4) world_to_camera.")
    rows = K.tolist()
    if rows[0][1] != 0 or rows[1][0] != 0 or rows[2] != [0, 0, 1]:
        raise BackendError(f"render: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], not {rows}.")
    if not (rows[0][0] > 0 and rows[1][1] > 0):
        raise BackendError(f"render: the focal lengths in K must be positive, not {rows}.")


def choose_device(asked: str) -> str:
    """The device for what was asked for; what cannot run is an error with the reason."""
    if asked not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device {asked}: expected auto, cpu or cuda.")
    if asked == "cuda":
        raise BackendError(
            "--device cuda: this version rasterises on the CPU only; pass --device cpu or auto."
        )
    return "cpu"
