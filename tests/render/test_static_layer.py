from dataclasses import replace

import pytest
import torch

from evsplat.errors import BackendError
from evsplat.render import Splats, render
from evsplat.render.splats import join


@pytest.fixture(name="two_layers")
def _two_layers(random_scene):
    """A few Gaussians that move over three times before and behind many that do not."""

    def make(seed, channels=3):
        size = dict(width=121, height=90, channels=channels)
        moving, _ = random_scene(seed, count=12, times=3, linear=True, **size)
        static, camera = random_scene(seed + 100, count=150, **size)
        moving.scales.mul_(0.3)
        # Some tie in depth with a static one: the moving one counts as nearer.
        static.means[0, 140:] = moving.means[1, 2:]
        return moving, static, camera

    return make


def bare_tiles(moving, camera):
    """Per time, which 16-pixel tiles no moving Gaussian touches."""
    alpha = render(moving, camera).alpha
    tiles = torch.nn.functional.max_pool2d(alpha[:, None], 16, ceil_mode=True)
    return (tiles == 0).flatten(1)


@pytest.mark.parametrize("seed", range(5))
def test_picture_is_that_of_all_gaussians_at_every_time(seed, two_layers):
    moving, static, camera = two_layers(seed)
    bare = bare_tiles(moving, camera)
    assert bare.all(0).any() and (~bare).any() and (bare.any(0) & ~bare.all(0)).any()
    apart = render(moving, camera, static=static, backend="native")
    together = render(join(moving, static, 3), camera, backend="native")
    assert torch.equal(apart.image, together.image)
    assert torch.equal(apart.alpha, together.alpha)
    assert torch.equal(apart.radii, together.radii[:, :12])
    assert torch.equal(apart.static_radii, together.radii[:1, 12:])


@pytest.mark.parametrize("background", [None, "colour", "picture"])
@pytest.mark.parametrize(("seed", "channels"), [(10, 3), (11, 1), (12, 37)])
def test_gradients_equal_the_float64_reference(
    seed, channels, background, two_layers, all_gradients
):
    moving, static, camera = two_layers(seed, channels)
    if background is not None:
        shape = (channels,) if background == "colour" else (camera.height, camera.width, channels)
        background = torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    options = dict(static=static, background=background)
    out, gradients = all_gradients(moving, camera, backend="native", dtype=torch.float32, **options)
    expected_out, expected = all_gradients(
        moving, camera, backend="reference", dtype=torch.float64, **options
    )
    assert (out.image - expected_out.image).abs().max() < 3e-5
    assert torch.equal(out.static_radii, expected_out.static_radii)
    errors = {
        name: ((gradients[name] - value).norm() / value.norm()).item()
        for name, value in expected.items()
    }
    assert max(errors.values()) < 1e-4, errors


def test_result_does_not_depend_on_the_number_of_threads(two_layers, all_gradients):
    moving, static, camera = two_layers(20)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        out, gradients = all_gradients(
            moving, camera, backend="native", dtype=torch.float32, static=static
        )
        results.append([out.image, out.alpha, *gradients.values()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_nothing_moving_or_nothing_static_is_drawn_as_one_layer(two_layers):
    moving, static, camera = two_layers(30)
    none = Splats(
        static.means[:, :0], static.quaternions[:, :0], static.scales[:, :0],
        static.opacities[:, :0], static.channels[:, :0],
    )  # fmt: skip
    alone = render(static, camera).image
    assert torch.equal(render(none, camera, static=static).image, alone)
    assert torch.equal(render(moving, camera, static=none).image, render(moving, camera).image)
    # Three empty times show the static picture three times.
    three = replace(none, means=none.means.expand(3, 0, 3))
    assert torch.equal(render(three, camera, static=static).image, alone.expand(3, -1, -1, -1))


def test_what_does_not_fit_the_moving_layer_is_refused(two_layers):
    moving, static, camera = two_layers(40)
    with pytest.raises(BackendError, match="static Gaussians have no axis of times"):
        render(moving, camera, static=replace(static, means=static.means.expand(2, -1, -1)))
    with pytest.raises(BackendError, match="static has 2 channels, but splats has 3"):
        render(moving, camera, static=replace(static, channels=static.channels[..., :2]))
    with pytest.raises(BackendError, match="static.quaternions has shape"):
        render(moving, camera, static=replace(static, quaternions=static.quaternions[..., :3]))
    with pytest.raises(BackendError, match=r"static.means is torch.float64"):
        doubled = [None if value is None else value.double() for value in vars(static).values()]
        render(moving, camera, static=Splats(*doubled))
