"""Pictures of posed Gaussians, with the person's shadow on the scene."""

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from evsplat.deform.lamps import Lamps
from evsplat.deform.shadow import BodyShadow
from evsplat.gaussians import PosedGaussians
from evsplat.render import Backdrop, PinholeCamera, RenderOutput, Splats, render, split_channels

SHADOW_STEP_PX = 2
"""Shadows are soft: they are looked up at every second pixel and interpolated."""
_LEAST_SCENE = 1e-3
"""Share of a pixel below which its scene has no place of its own."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Pictures of T times, and the two layers with what the rasteriser says of them."""

    rgb: tuple[Float[Tensor, "H W 3"], ...]
    semantic: tuple[Float[Tensor, "H W"], ...]
    output: RenderOutput
    posed: PosedGaussians
    moving: Splats
    static: Splats

    def center_gradients(self) -> tuple[Float[Tensor, "T H 2"], Float[Tensor, "1 S 2"]]:
        """Gradients of the projected centres of person and scene, per pixel, after backward."""
        moving, static = self.moving.centers2d_offset, self.static.centers2d_offset
        assert moving is not None and moving.grad is not None
        assert static is not None and static.grad is not None
        return moving.grad, static.grad

    def radii(self) -> tuple[Int[Tensor, "T H"], Int[Tensor, "1 S"]]:
        """Radii on the screen of the same rows, pixels; 0 = not drawn."""
        return self.output.radii, self.output.static_radii


class _Drawable(Protocol):
    @property
    def shadow(self) -> BodyShadow | None: ...

    @property
    def lamps(self) -> Lamps | None: ...


def draw(
    model: _Drawable,
    posed: PosedGaussians,
    camera: PinholeCamera,
    *,
    center_gradients: bool = False,
    background: Float[Tensor, "3"] | None = None,
    backdrop: Backdrop | None = None,
    shadow_step_px: int = SHADOW_STEP_PX,
) -> Drawing:
    """Draw person and scene; ``center_gradients`` makes the projected centres tell theirs.

    ``background`` is the sRGB colour behind all of it, black without. ``backdrop`` is what the
    scene looked like to the picture before, see `render`.

    With shadows the person's and the scene's share of each pixel are composited as channels of
    their own, in one pass and in the right order of depth, and the scene's is multiplied.
    """
    moving, static = posed.moving(), posed.static()
    shadow = model.shadow if posed.casters is not None else None
    if shadow is not None:
        moving, static = _in_layers(moving, static, camera)
    if center_gradients:
        moving, static = _with_centers(moving), _with_centers(static)
    behind = None if background is None else _behind(background, moving)
    output = render(
        moving,
        camera,
        static=static,
        background=behind,
        low_pass=posed.low_pass,
        backdrop=backdrop,
    )
    if shadow is None:
        rgb, semantic = split_channels(output.image, (3, 1))
    else:
        person, scene, depth, semantic = split_channels(output.image, (3, 3, 2, 1))
        assert posed.casters is not None and model.lamps is not None
        # What hides the scene hides its shadow as well: the first picture's depth serves all.
        places = _places(depth[0].detach(), camera, shadow_step_px)
        factors = shadow(posed.casters, places, model.lamps.places())
        light = _enlarge(factors, camera, shadow_step_px)
        rgb = tuple(
            a + b * factor[..., None] for a, b, factor in zip(person, scene, light, strict=True)
        )
    return Drawing(rgb, tuple(s[..., 0] for s in semantic), output, posed, moving, static)


def _behind(rgb: Float[Tensor, "3"], layer: Splats) -> Float[Tensor, "C"]:
    """A background of all channels: nothing stands there but the scene's colour."""
    rest = layer.channels.shape[-1] - 3
    # With layers, the scene's colour comes after the person's.
    first = 3 if rest > 3 else 0
    return F.pad(rgb, (first, rest - first))


def draw_depth(
    posed: PosedGaussians, camera: PinholeCamera, *, parts: Literal["all", "human", "scene"] = "all"
) -> Float[Tensor, "T H W"]:
    """Mean of z in the camera over what each pixel shows, metres; 0 where it shows nothing.

    The scene alone is drawn once: T is then 1.
    """
    moving, static = _showing_depth(posed.moving(), camera), _showing_depth(posed.static(), camera)
    if parts == "all":
        output = render(moving, camera, static=static, low_pass=posed.low_pass)
    else:
        layer = moving if parts == "human" else static
        output = render(layer, camera, low_pass=posed.low_pass)
    covered = output.alpha.clamp_min(_LEAST_SCENE)
    return output.image[..., 0] / covered * (output.alpha > _LEAST_SCENE)


def _showing_depth(layer: Splats, camera: PinholeCamera) -> Splats:
    pose = camera.world_to_camera
    return replace(layer, channels=(layer.means @ pose[2, :3] + pose[2, 3])[..., None])


def shadowed_scene(model: _Drawable, posed: PosedGaussians) -> Splats:
    """The scene's Gaussians with the person's shadow in their colours, one set per time.

    For files and viewers of others: the shadow is looked up at the centre of each Gaussian instead
    of at each pixel. Without shadows it is `PosedGaussians.static`.
    """
    scene = posed.static()
    if model.shadow is None or posed.casters is None:
        return scene
    assert model.lamps is not None
    light = model.shadow(posed.casters, scene.means, model.lamps.places())[:, 0, :, None]
    rgb, semantic = scene.channels.split((3, 1), -1)
    channels = [rgb * light, semantic.expand(posed.times, -1, -1)]
    return replace(scene, channels=torch.cat(channels, -1))


def _in_layers(moving: Splats, static: Splats, camera: PinholeCamera) -> tuple[Splats, Splats]:
    """Channels person's RGB, scene's RGB, scene's depth and share, semantic attribute."""
    rgb, semantic = moving.channels.split((3, 1), -1)
    nothing = rgb.new_zeros(*rgb.shape[:2], 5)
    moving = replace(moving, channels=torch.cat([rgb, nothing, semantic], -1))
    rgb, semantic = static.channels.split((3, 1), -1)
    pose = camera.world_to_camera
    depth = (static.means.detach() @ pose[2, :3] + pose[2, 3])[..., None]
    parts = [torch.zeros_like(rgb), rgb, depth, torch.ones_like(depth), semantic]
    return moving, replace(static, channels=torch.cat(parts, -1))


def _places(
    depth: Float[Tensor, "H W 2"], camera: PinholeCamera, step: int
) -> Float[Tensor, "h w 3"]:
    """World places of the scene at every ``step``-th pixel."""
    sums = F.avg_pool2d(depth.movedim(-1, 0), step, ceil_mode=True, count_include_pad=False)
    z = sums[0] / sums[1].clamp_min(_LEAST_SCENE)
    y, x = ((torch.arange(count, device=z.device) + 0.5) * step for count in z.shape)
    K, pose = camera.K, camera.world_to_camera.detach()
    rays = torch.stack(
        [
            ((x - K[0, 2]) / K[0, 0]).expand(z.shape),
            ((y - K[1, 2]) / K[1, 1])[:, None].expand(z.shape),
            torch.ones_like(z),
        ],
        -1,
    )
    return (rays * z[..., None] - pose[:3, 3]) @ pose[:3, :3]


def _enlarge(
    light: Float[Tensor, "T h w"], camera: PinholeCamera, step: int
) -> Float[Tensor, "T H W"]:
    full = F.interpolate(light[:, None], scale_factor=step, mode="bilinear")
    return full[:, 0, : camera.height, : camera.width]


def _with_centers(layer: Splats) -> Splats:
    shape = (*layer.means.shape[:2], 2)
    return replace(layer, centers2d_offset=layer.means.new_zeros(shape).requires_grad_())
