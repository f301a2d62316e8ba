"""Renders that share a static layer give the pictures of those that do not."""

from dataclasses import replace

import pytest
import torch

from evsplat.errors import BackendError
from evsplat.render import Backdrop, Splats, render

SIZE = dict(width=121, height=90)


@pytest.fixture(name="layers")
def _layers(random_scene):
    """Small Gaussians that move over four times before and behind many that do not."""

    def make(seed, channels=3):
        moving, _ = random_scene(seed, count=12, times=4, linear=True, channels=channels, **SIZE)
        static, camera = random_scene(seed + 100, count=150, channels=channels, **SIZE)
        moving.scales.mul_(0.3)
        return moving, static, camera

    return make


def at(splats, time):
    """One time of Gaussians that move."""
    values = vars(splats).items()
    return Splats(**{n: v if v is None or len(v) == 1 else v[time : time + 1] for n, v in values})


@torch.no_grad()
def assert_same(moving, camera, static, backdrop, **options):
    expected = render(moving, camera, static=static, backend="native", **options)
    found = render(moving, camera, static=static, backend="native", backdrop=backdrop, **options)
    for name in ("image", "alpha", "radii", "static_radii"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize(("seed", "channels"), [(0, 3), (1, 1), (2, 37)])
@pytest.mark.parametrize("with_background", [False, True])
def test_pictures_of_a_moving_layer_are_bit_for_bit_those_without(
    seed, channels, with_background, layers
):
    moving, static, camera = layers(seed, channels)
    background = torch.rand(channels) if with_background else None
    backdrop, jobs = Backdrop(), []
    for time in (0, 1, 2, 3, 0):
        assert_same(at(moving, time), camera, static, backdrop, background=background)
        jobs.append(backdrop.kept)
    assert_same(moving, camera, static, backdrop, background=background)
    assert None not in jobs


@torch.no_grad()
def test_the_static_layer_is_projected_once_and_bare_tiles_composited_once(layers):
    moving, static, camera = layers(5)
    moving, backdrop = at(moving, 0), Backdrop()
    first = render(moving, camera, static=static, backdrop=backdrop)
    touched = render(moving, camera).alpha[:, None]
    touched = torch.nn.functional.max_pool2d(touched, 16, ceil_mode=True) > 0
    touched = touched[0, 0].repeat_interleave(16, 0).repeat_interleave(16, 1)
    touched = touched[: camera.height, : camera.width]
    assert touched.any() and not touched.all()
    # Changed behind its back: whoever looked at the layer again would see it.
    static.means.data.add_(3.0)
    assert torch.equal(render(moving, camera, static=static, backdrop=backdrop).image, first.image)
    static.channels.data.add_(1.0)
    again = render(moving, camera, static=static, backdrop=backdrop)
    assert torch.equal(again.image[0, ~touched], first.image[0, ~touched])
    assert not torch.equal(again.image[0, touched], first.image[0, touched])


def test_whatever_changes_the_layer_or_the_camera_begins_anew(layers):
    moving, static, camera = layers(6)
    backdrop = Backdrop()
    show = dict(static=static, backdrop=backdrop)
    assert_same(at(moving, 0), camera, **show)
    for name in ("means", "quaternions", "scales", "opacities", "channels"):
        changed = replace(static, **{name: getattr(static, name) * 0.9 + 0.01})
        assert_same(at(moving, 1), camera, static=changed, backdrop=backdrop)
    assert_same(at(moving, 2), camera, **show)
    static.means.add_(0.02)  # in place: the same tensor, another scene
    assert_same(at(moving, 2), camera, **show)
    moved = camera.world_to_camera.clone()
    moved[:3, 3] += 0.05
    assert_same(at(moving, 2), replace(camera, world_to_camera=moved), **show)
    assert_same(
        at(moving, 2), replace(camera, K=camera.K * torch.tensor([[1.1], [1.1], [1]])), **show
    )
    assert_same(at(moving, 2), replace(camera, width=100, height=77), **show)
    assert_same(at(moving, 2), camera, background=torch.rand(3), **show)
    assert_same(at(moving, 2), camera, near=0.5, **show)
    assert_same(at(moving, 2), camera, low_pass=0.1, **show)
    fewer = Splats(*(None if v is None else v[:, :7] for v in vars(at(moving, 2)).values()))
    assert_same(fewer, camera, **show)


def test_without_a_static_layer_there_is_nothing_to_keep(layers):
    moving, _, camera = layers(7)
    backdrop = Backdrop()
    assert_same(moving, camera, None, backdrop)
    assert backdrop.kept is None


def test_there_are_no_gradients(layers):
    moving, static, camera = layers(8)
    with pytest.raises(BackendError, match="no gradients"):
        render(moving, camera, static=static, backdrop=Backdrop())
