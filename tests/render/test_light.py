"""A light on the static layer: the compiled one against layers that are drawn apart."""

from dataclasses import fields, replace

import pytest
import torch

from evsplat import _native
from evsplat.errors import BackendError
from evsplat.render import Backdrop, Splats, render

SIZE = dict(width=121, height=90)
TIMES = 3


@pytest.fixture(name="layers")
def _layers(random_scene):
    """A few Gaussians that move before and behind many that do not; many tiles see none of them."""

    def make(seed, channels):
        moving, _ = random_scene(
            seed, count=12, times=TIMES, linear=True, channels=channels, **SIZE
        )
        static, camera = random_scene(seed + 100, count=150, channels=channels, **SIZE)
        moving.scales.mul_(0.3)
        generator = torch.Generator().manual_seed(seed)
        light = torch.rand(TIMES, SIZE["height"], SIZE["width"], generator=generator)
        return moving, static, camera, light

    return make


def drawn(layers, backend, dtype, background=None):
    """The pictures, and the gradients of everything by a fixed sum over picture and coverage."""
    moving, static, camera, light = layers
    leaves = [
        {f.name: getattr(layer, f.name).to(dtype).clone().requires_grad_() for f in fields(Splats)
         if getattr(layer, f.name) is not None}
        for layer in (moving, static)
    ]  # fmt: skip
    light = light.to(dtype).clone().requires_grad_()
    camera = replace(camera, K=camera.K.to(dtype), world_to_camera=camera.world_to_camera.to(dtype))
    output = render(
        Splats(**leaves[0]),
        camera,
        static=Splats(**leaves[1]),
        static_light=light,
        backend=backend,
        background=None if background is None else background.to(dtype),
    )
    generator = torch.Generator().manual_seed(0)
    by_image = torch.randn(output.image.shape, generator=generator).to(dtype)
    by_alpha = torch.randn(output.alpha.shape, generator=generator).to(dtype)
    ((output.image * by_image).sum() + (output.alpha * by_alpha).sum()).backward()
    names = [(part, name) for part, layer in enumerate(leaves) for name in layer]
    return output, {(0, "light"): light.grad} | {key: leaves[key[0]][key[1]].grad for key in names}


@pytest.mark.parametrize("level", _native.levels())
@pytest.mark.parametrize(("seed", "channels", "behind"), [(0, 4, 0), (1, 3, 1), (2, 9, 1)])
def test_pictures_and_gradients_are_those_of_layers_drawn_apart(
    level, seed, channels, behind, layers, monkeypatch
):
    monkeypatch.setenv("EVSPLAT_ISA", level)
    given = layers(seed, channels)
    background = torch.rand(channels) if behind else None
    found, gradients = drawn(given, "native", torch.float32, background)
    expected, wanted = drawn(given, "reference", torch.float64, background)
    assert (found.image - expected.image).abs().max() < 3e-5
    assert torch.equal(found.radii, expected.radii)
    for name, want in wanted.items():
        assert (gradients[name] - want).norm() < 1e-4 * want.norm(), name


def test_a_light_of_one_changes_nothing(layers):
    moving, static, camera, light = layers(3, 4)
    plain = render(moving, camera, static=static)
    lit = render(moving, camera, static=static, static_light=torch.ones_like(light))
    assert torch.equal(lit.image, plain.image) and torch.equal(lit.alpha, plain.alpha)


@torch.no_grad()
def test_a_kept_layer_is_lit_anew_in_each_picture(layers):
    moving, static, camera, light = layers(4, 4)
    backdrop = Backdrop()
    for factor in (1.0, 0.5, 0.25):
        options = {"static": static, "static_light": factor * light}
        expected = render(moving, camera, **options)
        found = render(moving, camera, **options, backdrop=backdrop)
        assert torch.equal(found.image, expected.image)


def test_a_light_that_does_not_fit_is_refused(layers):
    moving, static, camera, light = layers(5, 4)
    with pytest.raises(BackendError, match=r"static_light has shape \(2, 90, 121\), expected"):
        render(moving, camera, static=static, static_light=light[:2])
    with pytest.raises(BackendError, match="static_light falls on static Gaussians"):
        render(moving, camera, static_light=light)
    narrow = [replace(layer, channels=layer.channels[..., :2]) for layer in (moving, static)]
    with pytest.raises(BackendError, match="static_light needs 3 to 32 channels, not 2"):
        render(narrow[0], camera, static=narrow[1], static_light=light)
