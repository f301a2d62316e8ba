"""Pictures of posed Gaussians, with the person's shadow on the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from evsplat.camera import Camera, distinct
from evsplat.compiled import native, runs_native
from evsplat.models.layers import SHADOW_STEP_PX, Layers
from evsplat.models.scene_places import LEAST_SCENE, ScenePlaces
from evsplat.render import Backdrop, RenderOutput, Splats, render


@dataclass(frozen=True, eq=False)
class Drawing:
    """Pictures of T times, and the two layers with what the rasteriser says of them."""

    rgb: tuple[Float[Tensor, "H W 3"], ...]
    semantic: tuple[Float[Tensor, "H W"], ...]
    output: RenderOutput
    layers: Layers
    """As they were drawn: with a shadow, and with centres that have gradients."""

    def center_gradients(self) -> tuple[Float[Tensor, "T H 2"], Float[Tensor, "1 S 2"]]:
        """Gradients of the projected centres of person and scene, per pixel, after backward."""
        human, scene = self.layers.human.centers2d_offset, self.layers.scene.centers2d_offset
        assert human is not None and human.grad is not None
        assert scene is not None and scene.grad is not None
        return human.grad, scene.grad

    def radii(self) -> tuple[Int[Tensor, "T H"], Int[Tensor, "1 S"]]:
        """Radii on the screen of the same rows, pixels; 0 = not drawn."""
        return self.output.radii, self.output.static_radii


def draw(
    layers: Layers,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | None = None,
    backdrop: Backdrop | None = None,
    places: ScenePlaces | None = None,
    shadow_step_px: int = SHADOW_STEP_PX,
) -> Drawing:
    """Draw person and scene at all times from one camera.

    ``background`` is the sRGB colour behind all of it, black without. ``backdrop`` is what the
    scene looked like to the picture before, see `render`.

    With a shadow the scene's share of each pixel is multiplied by it. It falls on the places that
    ``places`` tells of the scene without the person; without, they are drawn for this picture.
    """
    human, scene = layers.human, layers.scene
    light = None
    if layers.shaded is not None:
        light = _enlarge(layers.shaded, camera, SHADOW_STEP_PX)
    elif layers.shadow is not None:
        if places is None:
            places = ScenePlaces() if backdrop is None else backdrop.beside(ScenePlaces)
        factors = layers.shadow(places.of(layers, camera, shadow_step_px))
        light = _enlarge(factors, camera, shadow_step_px)
    output = render(
        human,
        camera,
        static=scene,
        background=None if background is None else _behind(background, human),
        low_pass=layers.low_pass,
        backdrop=backdrop,
        static_light=light,
        groups=(3, 1),
    )
    rgb, semantic = output.groups
    return Drawing(rgb, tuple(s.squeeze(-1) for s in semantic), output, layers)


def draw_for_training(
    layers: Layers,
    cameras: Sequence[Camera],
    *,
    background: Float[Tensor, "3"] | None = None,
    places: ScenePlaces | None = None,
) -> Drawing:
    """Draw each time as that time's camera sees it, with gradients of the projected centres.

    Of a camera at rest all are one object: then the scene is projected once, as by `draw`.
    """
    human, scene = _with_centers(layers.human), _with_centers(layers.scene)
    layers, cameras = replace(layers, human=human, scene=scene), distinct(cameras)
    if len(cameras) == 1:
        return draw(layers, cameras[0], background=background, places=places)
    each = [
        draw(layers.of_time(index), camera, background=background, places=places)
        for index, camera in enumerate(cameras)
    ]
    outputs = [one.output for one in each]
    output = RenderOutput(
        image=torch.cat([one.image for one in outputs]),
        alpha=torch.cat([one.alpha for one in outputs]),
        radii=torch.cat([one.radii for one in outputs]),
        static_radii=torch.stack([one.static_radii for one in outputs]).amax(0),
    )
    rgb = tuple(picture for one in each for picture in one.rgb)
    semantic = tuple(picture for one in each for picture in one.semantic)
    return Drawing(rgb, semantic, output, layers)


def _behind(rgb: Float[Tensor, "3"], layer: Splats) -> Float[Tensor, "C"]:
    """A background of all channels: nothing stands there but the scene's colour."""
    return F.pad(rgb, (0, layer.channels.shape[-1] - 3))


def draw_depth(
    layers: Layers, camera: Camera, *, parts: Literal["all", "human", "scene"] = "all"
) -> Float[Tensor, "T H W"]:
    """Mean of z in the camera over what each pixel shows, metres; 0 where it shows nothing.

    The scene alone is drawn once: T is then 1.
    """
    human, scene = _showing_depth(layers.human, camera), _showing_depth(layers.scene, camera)
    if parts == "all":
        output = render(human, camera, static=scene, low_pass=layers.low_pass)
    else:
        output = render(human if parts == "human" else scene, camera, low_pass=layers.low_pass)
    covered = output.alpha.clamp_min(LEAST_SCENE)
    return output.image[..., 0] / covered * (output.alpha > LEAST_SCENE)


def _showing_depth(layer: Splats, camera: Camera) -> Splats:
    return replace(layer, channels=camera.depth(layer.means)[..., None])


def shadowed_scene(layers: Layers) -> Splats:
    """The scene's Gaussians with the person's shadow in their colours, one set per time.

    For files and viewers of others: the shadow is looked up at the centre of each Gaussian instead
    of at each pixel. Without a shadow it is the scene as it is.
    """
    scene = layers.scene
    if layers.shadow is None:
        return scene
    light = layers.shadow(scene.means)[:, 0, :, None]
    rgb, semantic = scene.channels.split((3, 1), -1)
    channels = [rgb * light, semantic.expand(layers.times, -1, -1)]
    return replace(scene, channels=torch.cat(channels, -1))


def _enlarge(light: Float[Tensor, "T h w"], camera: Camera, step: int) -> Float[Tensor, "T H W"]:
    if runs_native(light):
        large: Tensor = _Enlarge.apply(light, camera.height, camera.width, step)
        return large
    full = F.interpolate(light[:, None], scale_factor=step, mode="bilinear")
    return full.squeeze(1)[:, : camera.height, : camera.width]


class _Enlarge(torch.autograd.Function):
    """The same in the compiled module."""

    @staticmethod
    def forward(ctx: Any, light: Tensor, height: int, width: int, step: int) -> Tensor:
        ctx.step, ctx.size = step, light.shape
        large = light.new_empty(len(light), height, width)
        native.enlarge(light.detach().contiguous(), step, large, False, torch.get_num_threads())
        return large

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        small = upstream[0].new_empty(ctx.size)
        above = upstream[0].contiguous()
        native.enlarge(above, ctx.step, small, True, torch.get_num_threads())
        return small, None, None, None


def _with_centers(layer: Splats) -> Splats:
    shape = (*layer.means.shape[:2], 2)
    return replace(layer, centers2d_offset=layer.means.new_zeros(shape).requires_grad_())
