"""The gsplat backend: on a GPU where there is one, and everywhere with its kernels in torch."""

from dataclasses import fields, replace

import pytest
import torch

from evsplat import cuda_support
from evsplat.errors import BackendError
from evsplat.render import Splats, api, choose_device, cuda, render

from .gsplat_on_cpu import install

GRADIENT_BOUND = 1e-3
MILD = 5
"""Length by width of the longest Gaussians; needles have a test of their own."""
CASES = {
    "plain": dict(seed=0),
    "whole tiles": dict(seed=1, width=64, height=48),
    "smaller than a tile": dict(seed=2, width=13, height=7, count=60),
    "one channel": dict(seed=3, channels=1),
    "six channels": dict(seed=6, channels=6),
    "more channels than a block": dict(seed=8, channels=37, width=33, height=30),
    "sheared": dict(seed=9, linear=True),
    "three times": dict(seed=10, times=3, linear=True, width=35, height=33),
    "times share geometry": dict(seed=11, times=3, shared=True, width=35, height=33),
}


@pytest.fixture(params=["stand-in", "gpu"])
def device(request, monkeypatch):
    """Device of the backend: the GPU, or the CPU with gsplat's kernels in torch."""
    if request.param == "gpu":
        missing = cuda_support.what_is_missing()
        if missing is not None:
            pytest.skip(f"needs an NVIDIA GPU with gsplat: {missing}")
        return "cuda"
    gsplat = install(monkeypatch)
    backends = api._BACKENDS | {"gsplat": lambda job: cuda.draw(gsplat, job)}
    monkeypatch.setattr(api, "_BACKENDS", backends)
    return "cpu"


def assert_alike(ours, native, splats):
    """Pictures within 1e-4 and gradients within 1e-3, as far as rounding can decide.

    Where it decides whether a Gaussian's alpha reaches 1/255, a pixel differs by up to that much of
    the Gaussian's channels; where it decides a ceiling, a radius differs by one.
    """
    (out, gradients), (expected, expected_gradients) = ours, native
    brightest = splats.channels.abs().max() + 1
    for value, wanted in ((out.image, expected.image), (out.alpha, expected.alpha)):
        error = (value - wanted).abs()
        assert error.max() <= 1.1 * brightest / 255
        assert (error > 1e-4).float().mean() <= 2e-4, error.max()
    for value, wanted in ((out.radii, expected.radii), (out.static_radii, expected.static_radii)):
        assert value.shape == wanted.shape and value.dtype == wanted.dtype
        assert torch.equal(value > 0, wanted > 0)
        assert (value - wanted).abs().max() <= 1 if value.numel() else True
        assert (value != wanted).float().sum() <= max(1, 0.01 * value.numel())
    errors = {
        name: ((gradients[name] - value).norm() / value.norm()).item()
        for name, value in expected_gradients.items()
    }
    assert max(errors.values()) < GRADIENT_BOUND, errors


@pytest.mark.parametrize(
    ("case", "background"),
    [(case, "colour") for case in CASES] + [("plain", None), ("three times", "picture")],
)
def test_pictures_and_gradients_are_those_of_native(
    case, background, device, random_scene, all_gradients
):
    splats, camera = random_scene(**CASES[case], needle=MILD)
    channels = splats.channels.shape[-1]
    if background is not None:
        shape = (channels,) if background == "colour" else (camera.height, camera.width, channels)
        background = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    options = dict(dtype=torch.float32, background=background)
    ours = all_gradients(splats, camera, backend="gsplat", device=device, **options)
    assert_alike(ours, all_gradients(splats, camera, backend="native", **options), splats)


def test_a_low_pass_of_ones_own_is_that_of_native(device, random_scene, all_gradients):
    splats, camera = random_scene(**CASES["sheared"], needle=MILD)
    options = dict(dtype=torch.float32, low_pass=0.1)
    ours = all_gradients(splats, camera, backend="gsplat", device=device, **options)
    assert_alike(ours, all_gradients(splats, camera, backend="native", **options), splats)


@pytest.mark.parametrize("seed", range(4))
def test_a_static_layer_is_drawn_at_every_time(seed, device, random_scene, all_gradients):
    size = dict(width=45, height=37, needle=MILD)
    moving, _ = random_scene(seed, count=30, times=3, linear=seed % 2 == 0, **size)
    static, camera = random_scene(seed + 100, count=90, **size)
    options = dict(dtype=torch.float32, static=static)
    ours = all_gradients(moving, camera, backend="gsplat", device=device, **options)
    assert_alike(ours, all_gradients(moving, camera, backend="native", **options), static)


@pytest.mark.parametrize("seed", range(3))
def test_what_stands_still_is_shared_by_all_times_but_around_what_moves(
    seed, device, random_scene, all_gradients, monkeypatch
):
    """Its rows are there once, it is binned once, and again in the box around the moving ones."""
    size = dict(width=120, height=100, needle=MILD)
    moving, _ = random_scene(seed, count=12, times=4, **size)
    closer = torch.tensor([0.1, 0.1, 1.0])
    small = replace(moving, means=moving.means * closer, scales=0.1 * moving.scales)
    static, camera = random_scene(seed + 100, count=100, **size)
    static = replace(static, scales=0.3 * static.scales)
    rows, pairs, composite = [], [], cuda._composite

    class Watched:
        def __init__(self, gsplat):
            self.gsplat = gsplat

        def __getattr__(self, name):
            return getattr(self.gsplat, name)

        def rasterize_to_pixels(self, centers, *rest, **options):
            rows.append(len(centers))
            pairs.append(len(rest[7]))
            return self.gsplat.rasterize_to_pixels(centers, *rest, **options)

    monkeypatch.setattr(cuda, "_composite", lambda gsplat, *rest: composite(Watched(gsplat), *rest))
    options = dict(dtype=torch.float32, static=static)
    ours = all_gradients(small, camera, backend="gsplat", device=device, **options)
    assert_alike(ours, all_gradients(small, camera, backend="native", **options), static)
    for alone in (static, small):
        all_gradients(alone, camera, backend="gsplat", device=device, dtype=torch.float32)
    assert rows == [4 * 12 + 100, 100, 4 * 12]
    assert pairs[1] + pairs[2] <= pairs[0] < 2.5 * pairs[1] + pairs[2]


def test_needles_lose_digits_in_float32(device, random_scene, all_gradients):
    """Up to 4 m long a metre away: gsplat's quadratic form cancels, native's does not."""
    splats, camera = random_scene(0, needle=20)
    out, gradients = all_gradients(
        splats, camera, backend="gsplat", dtype=torch.float32, device=device
    )
    expected, wanted = all_gradients(splats, camera, backend="native", dtype=torch.float32)
    assert (out.image - expected.image).abs().max() < 1e-2
    errors = {
        name: ((gradients[name] - value).norm() / value.norm()).item()
        for name, value in wanted.items()
    }
    assert max(errors.values()) < 5e-2, errors


@pytest.mark.parametrize("field", ["means", "quaternions", "scales", "opacities", "linear"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_a_broken_gaussian_is_not_drawn_and_harms_no_other(field, bad, device, random_scene):
    splats, camera = random_scene(10, linear=True)
    broken = getattr(splats, field).clone()
    broken.view(1, 200, -1)[0, 50] = bad
    gone = splats.opacities.clone()
    gone[0, 50] = 0
    leaves = on(replace(splats, **{field: broken}), device)
    means = leaves.means.clone().requires_grad_()
    out = render(replace(leaves, means=means), camera, backend="gsplat")
    expected = render(on(replace(splats, opacities=gone), device), camera, backend="gsplat")
    # 1e38 of an opacity is opaque, of a quaternion a rotation; both are drawn as any other.
    if out.radii[0, 50] == 0:
        assert torch.equal(out.image, expected.image)
    else:
        assert bad == 1e38 and field in ("opacities", "quaternions")
    (gradient,) = torch.autograd.grad(out.image.sum(), means)
    others = torch.arange(200) != 50
    assert torch.isfinite(gradient[0, others]).all()


def test_equal_depths_keep_the_order_of_the_gaussians(device, camera, pile):
    splats, expected = pile
    out = render(on(splats, device), camera, backend="gsplat")
    assert out.image[0, 16, 20, 0].item() == pytest.approx(expected, rel=1e-4)


def test_nothing_to_draw_leaves_the_background(device, camera):
    empty = Splats(
        torch.zeros(2, 0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0),
        torch.zeros(2, 0, 2),
    )  # fmt: skip
    behind = Splats(
        torch.tensor([[[0.0, 0.0, -1.0]]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1),
        torch.ones(1, 1, 2),
    )  # fmt: skip
    background = torch.tensor([0.25, 0.75], device=device, requires_grad=True)
    for splats, static in ((empty, None), (empty, behind), (behind, None)):
        still = None if static is None else on(static, device)
        out = render(
            on(splats, device), camera, static=still, background=background, backend="gsplat"
        )
        times = len(splats.means)
        assert torch.equal(out.image, background.expand(times, 33, 41, 2))
        assert out.radii.shape == (times, splats.means.shape[1]) and not out.radii.any()
        (gradient,) = torch.autograd.grad(out.image.sum(), background)
        assert gradient.tolist() == [times * 33 * 41, times * 33 * 41]


def test_what_cannot_run_says_why(random_scene, monkeypatch):
    splats, camera = random_scene(0)
    with pytest.raises(BackendError, match="needs float32 tensors on a CUDA device, not torch.f"):
        render(splats, camera, backend="gsplat")
    monkeypatch.setattr(cuda, "what_is_missing", lambda: "gsplat: not installed. Get it.")
    with pytest.raises(BackendError, match="cannot run here. gsplat: not installed. Get it."):
        cuda.load.__wrapped__()


@pytest.mark.parametrize("missing", [None, "gsplat: not installed."])
def test_device_is_cuda_only_where_all_of_it_is_there(missing, monkeypatch):
    monkeypatch.setattr(api, "what_is_missing", lambda: missing)
    assert choose_device("cpu") == "cpu"
    if missing is None:
        assert choose_device("auto") == choose_device("cuda") == "cuda"
    else:
        assert choose_device("auto") == "cpu"
        with pytest.raises(BackendError, match="--device cuda: gsplat: not installed."):
            choose_device("cuda")


def on(splats, device):
    values = {f.name: getattr(splats, f.name) for f in fields(Splats)}
    return Splats(**{k: None if v is None else v.to(device) for k, v in values.items()})
