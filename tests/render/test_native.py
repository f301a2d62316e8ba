from dataclasses import replace

import pytest
import torch

from evsplat import _native
from evsplat.errors import BackendError
from evsplat.render import Splats, render

# Relative L2 that every gradient must stay under. Typical are 1e-6; the worst over 100 such scenes
# was 8e-5, of quaternions, where a needle fills the screen.
BOUND = 1e-4


def relative_error(value, expected):
    return ((value - expected).norm() / expected.norm()).item()


CASES = {
    "plain": dict(seed=0),
    "whole tiles": dict(seed=1, width=64, height=48),
    "smaller than a tile": dict(seed=2, width=13, height=7, count=60),
    "one channel": dict(seed=3, channels=1),
    "two channels": dict(seed=4, channels=2),
    "five channels": dict(seed=5, channels=5),
    "eight channels": dict(seed=6, channels=8),
    "nine channels": dict(seed=7, channels=9),
    "more channels than a block": dict(seed=8, channels=37, width=33, height=30),
    "sheared": dict(seed=9, linear=True),
    "three times": dict(seed=10, times=3, linear=True, width=35, height=33),
    "times share geometry": dict(seed=11, times=3, shared=True, width=35, height=33),
    "dense": dict(seed=12, count=900, width=40, height=40),
}


@pytest.mark.parametrize(
    ("case", "background"),
    [(case, "colour") for case in CASES]
    + [
        (case, background)
        for case in ("plain", "three times", "more channels than a block")
        for background in (None, "picture")
    ],
)
def test_gradients_equal_the_float64_reference(case, background, random_scene, all_gradients):
    splats, camera = random_scene(**CASES[case])
    channels = splats.channels.shape[-1]
    if background is not None:
        shape = (channels,) if background == "colour" else (camera.height, camera.width, channels)
        background = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    out, gradients = all_gradients(
        splats, camera, backend="native", dtype=torch.float32, background=background
    )
    expected_out, expected = all_gradients(
        splats, camera, backend="reference", dtype=torch.float64, background=background
    )
    assert (out.image - expected_out.image).abs().max() < 3e-5
    assert (out.alpha - expected_out.alpha).abs().max() < 1e-5
    assert torch.equal(out.radii, expected_out.radii)
    assert (out.radii > 0).any() and (out.radii == 0).any()
    errors = {name: relative_error(gradients[name], expected[name]) for name in expected}
    assert max(errors.values()) < BOUND, errors


@pytest.mark.parametrize("seed", range(20, 30))
def test_gradients_hold_over_seeds(seed, random_scene, all_gradients):
    splats, camera = random_scene(seed, count=120, width=37, height=35, linear=seed % 2 == 0)
    gradients = all_gradients(splats, camera, backend="native", dtype=torch.float32)[1]
    expected = all_gradients(splats, camera, backend="reference", dtype=torch.float64)[1]
    errors = {name: relative_error(gradients[name], expected[name]) for name in expected}
    assert max(errors.values()) < BOUND, errors


def test_a_long_needle_keeps_its_digits(camera, all_gradients):
    """100 px long, under 1 px wide, across the image: where the usual quadratic form loses 1e-3."""
    angle = torch.tensor(0.8)
    splats = Splats(
        means=torch.tensor([[[0.02, -0.01, 1.0]]]),
        quaternions=torch.stack([torch.cos(angle / 2), angle * 0, angle * 0, torch.sin(angle / 2)])[
            None
        ],
        scales=torch.tensor([[2.0, 1e-4, 1e-4]]),
        opacities=torch.tensor([0.8]),
        channels=torch.ones(1, 1, 1),
    )
    out, gradients = all_gradients(splats, camera, backend="native", dtype=torch.float32)
    expected_out, expected = all_gradients(splats, camera, backend="reference", dtype=torch.float64)
    assert (out.image - expected_out.image).abs().max() < 1e-5
    errors = {name: relative_error(gradients[name], expected[name]) for name in expected}
    assert max(errors.values()) < 5e-5, errors


def test_gradients_survive_behind_an_opaque_wall(camera):
    """0.9985 opaque over the whole image: what is behind weighs 1e-3 and still has its gradient."""
    splats = Splats(
        means=torch.tensor([[[0.0, 0, 1.0], [0.05, 0.02, 1.5], [0, 0, 2.0]]]),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4),
        scales=torch.tensor([[30.0, 30, 0.01], [0.1, 0.05, 0.1], [5, 5, 5]]),
        opacities=torch.tensor([0.9985, 0.7, 0.6]),
        channels=torch.rand(1, 3, 3, generator=torch.Generator().manual_seed(0)),
    )

    def gradient(backend, dtype):
        leaves = {
            name: getattr(splats, name).to(dtype).clone().requires_grad_()
            for name in ("means", "quaternions", "scales", "opacities", "channels")
        }
        image = render(Splats(**leaves), camera, backend=backend).image
        # Smooth weights: with random ones, sums near zero would measure the rounding of the light
        # that passes the wall, 2e-5 a pixel because alpha rounds by 3e-8.
        ramp = torch.linspace(0, 1, 41, dtype=dtype)[:, None] * torch.linspace(
            1, 2, 33, dtype=dtype
        ).square().view(-1, 1, 1)
        return torch.autograd.grad((image * ramp).sum(), list(leaves.values()))

    for value, expected in zip(
        gradient("native", torch.float32), gradient("reference", torch.float64), strict=True
    ):
        assert relative_error(value.view(3, -1)[1], expected.view(3, -1)[1]) < 5e-5


def one_gaussian(opacity=0.7, sigma=0.1):
    return Splats(
        means=torch.tensor([[[0.0, 0, 1.0]]]),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), sigma),
        opacities=torch.tensor([opacity]),
        channels=torch.tensor([[[2.0]]]),
    )


@pytest.mark.parametrize("low_pass", [0.3, 0.1])
@pytest.mark.parametrize("backend", ["native", "reference"])
def test_one_gaussian_has_its_closed_form(backend, low_pass, camera):
    """sigma 0.02 m at 1 m is 1 px, plus the low-pass; centred on pixel (20, 16)."""
    out = render(one_gaussian(sigma=0.02), camera, low_pass=low_pass, backend=backend)
    x, y = torch.meshgrid(torch.arange(41.0) - 20, torch.arange(33.0) - 16, indexing="xy")
    # The Jacobian's z column is zero on the axis, so the covariance is isotropic.
    alpha = 0.7 * torch.exp(-0.5 * (x * x + y * y) / (1 + low_pass))
    alpha[alpha < 1 / 255] = 0
    torch.testing.assert_close(out.alpha[0], alpha, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(out.image[0, ..., 0], 2 * alpha, atol=1e-6, rtol=1e-5)
    # sqrt(2 ln(255 * 0.7)) = 3.22 deviations of 1.14 or 1.05 px
    assert out.radii.tolist() == [[4]]


@pytest.mark.parametrize("seed", range(40, 43))
@pytest.mark.parametrize("low_pass", [0.02, 0.1, 1.0])
def test_gradients_hold_for_any_low_pass(seed, low_pass, random_scene, all_gradients):
    splats, camera = random_scene(seed, count=120, width=37, height=35, linear=seed % 2 == 0)
    gradients, expected = (
        all_gradients(splats, camera, backend=backend, dtype=dtype, low_pass=low_pass)[1]
        for backend, dtype in (("native", torch.float32), ("reference", torch.float64))
    )
    errors = {name: relative_error(gradients[name], expected[name]) for name in expected}
    assert max(errors.values()) < BOUND, errors


def test_a_low_pass_of_nothing_is_refused(camera):
    with pytest.raises(BackendError, match=r"low_pass is 0.0, expected px\^2 above 0"):
        render(one_gaussian(), camera, low_pass=0.0)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_alpha_is_at_most_0_999_and_the_clamp_stops_the_gradient(backend, camera):
    splats = one_gaussian(opacity=1.0)
    opacities = splats.opacities.clone().requires_grad_()
    out = render(replace(splats, opacities=opacities), camera, backend=backend)
    assert out.alpha.max().item() == pytest.approx(0.999, abs=1e-6)
    (gradient,) = torch.autograd.grad(out.alpha[0, 16, 20], opacities)
    assert gradient.item() == 0


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_compositing_stops_before_the_transmittance_reaches_the_limit(backend, camera):
    """Two layers leave 0.04^2 = 1.6e-3; a third, at 6.4e-5, and all behind are left out."""
    splats = Splats(
        means=torch.tensor([[[0.0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 4]]]),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4),
        scales=torch.full((4, 3), 1e3),
        opacities=torch.full((4,), 0.96),
        channels=torch.eye(4)[None],
    )
    out = render(splats, camera, backend=backend)
    expected = torch.tensor([0.96, 0.96 * 0.04, 0, 0])
    torch.testing.assert_close(out.image[0, 16, 20], expected, atol=1e-5, rtol=0)
    assert out.alpha[0, 16, 20].item() == pytest.approx(1 - 0.04**2, abs=1e-5)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_equal_depths_keep_the_order_of_the_gaussians(backend, camera, pile):
    splats, expected = pile
    out = render(splats, camera, backend=backend)
    assert out.image[0, 16, 20, 0].item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("depths", ["uniform", "clustered", "descending", "few levels"])
def test_crowded_tiles_are_sorted_by_depth(depths, camera):
    """Thousands of Gaussians in one tile, by every path of the sort."""
    count = 3000
    generator = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(count, generator=generator)
    if depths == "clustered":  # the differing high bits are those of one outlier
        depth = 1 + 1e-3 * depth
        depth[7] = 500
    elif depths == "descending":
        depth = depth.sort(descending=True).values
    elif depths == "few levels":
        depth = (4 * depth).round() / 4
    splats = Splats(
        means=torch.stack([0 * depth, 0 * depth, depth], -1)[None],
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        scales=torch.full((count, 3), 100.0),
        opacities=torch.full((count,), 0.005),
        channels=torch.rand(1, count, 2, generator=generator),
    )
    camera = replace(camera, width=9, height=8)
    out = render(splats, camera, backend="native")
    order = depth.sort(stable=True).indices
    alpha = 0.005  # the Gaussians are so wide that every pixel sees their opacity
    weights = alpha * (1 - alpha) ** torch.arange(count, dtype=torch.float64)
    weights[(1 - alpha) ** torch.arange(1, count + 1) <= 1e-4] = 0
    expected = (weights[:, None] * splats.channels[0, order].double()).sum(0)
    torch.testing.assert_close(out.image[0, 4, 4].double(), expected, atol=2e-4, rtol=0)


def test_two_threads_give_the_same_bits_as_one(random_scene, all_gradients):
    splats, camera = random_scene(3, count=3000, times=2, width=150, height=130, linear=True)
    background = torch.rand(3)
    results = []
    for threads in (1, 2, 2):
        torch.set_num_threads(threads)
        results.append(
            all_gradients(
                splats, camera, backend="native", dtype=torch.float32, background=background
            )
        )
    (out, gradients), *others = results
    for other_out, other in others:
        assert torch.equal(out.image, other_out.image)
        assert torch.equal(out.alpha, other_out.alpha)
        for name in gradients:
            assert torch.equal(gradients[name], other[name]), name


@pytest.mark.parametrize("count", [200, 900])  # of 900 a tile has more than are handled together
@pytest.mark.parametrize("level", ["avx512", "avx2", "portable"])
def test_simd_levels_agree_within_rounding(level, count, monkeypatch, random_scene, all_gradients):
    if level not in _native.levels():
        pytest.skip(f"this CPU has no {level}")
    splats, camera = random_scene(
        7, count=count, times=2, width=53, height=50, linear=True, channels=4
    )
    monkeypatch.setenv("EVSPLAT_ISA", level)
    assert _native.level() == level
    out, gradients = all_gradients(splats, camera, backend="native", dtype=torch.float32)
    expected_out, expected = all_gradients(splats, camera, backend="reference", dtype=torch.float64)
    assert (out.image - expected_out.image).abs().max() < 3e-5
    assert torch.equal(out.radii, expected_out.radii)
    errors = {name: relative_error(gradients[name], expected[name]) for name in expected}
    assert max(errors.values()) < BOUND, errors


def test_moving_camera_and_gaussians_together_changes_nothing(random_scene):
    splats, camera = random_scene(5)
    pose = camera.world_to_camera
    still = replace(camera, world_to_camera=torch.eye(4))
    moved = replace(
        splats,
        means=splats.means @ pose[:3, :3].T + pose[:3, 3],
        linear=pose[:3, :3].expand(1, splats.means.shape[1], 3, 3),
    )
    before = render(splats, camera, backend="native")
    after = render(moved, still, backend="native")
    assert (before.image - after.image).abs().max() < 1e-4


def test_times_are_independent_renders(random_scene):
    splats, camera = random_scene(6, times=3, linear=True)
    together = render(splats, camera)
    for t in range(3):
        one = Splats(
            splats.means[t : t + 1], splats.quaternions[t], splats.scales[t], splats.opacities[t],
            splats.channels[t : t + 1], splats.linear[t : t + 1],
        )  # fmt: skip
        alone = render(one, camera)
        assert torch.equal(alone.image[0], together.image[t])
        assert torch.equal(alone.radii[0], together.radii[t])


def test_shifting_the_centres_equals_shifting_the_image(camera):
    shift = torch.tensor([[[3.0, -2.0]]])
    plain = render(one_gaussian(), camera, backend="native").image
    moved = replace(one_gaussian(), centers2d_offset=shift)
    shifted = render(moved, camera, backend="native").image
    torch.testing.assert_close(shifted[:, :-2, 3:], plain[:, 2:, :-3], atol=1e-6, rtol=1e-5)


def test_any_layout_of_the_incoming_gradient_gives_the_same(random_scene):
    splats, camera = random_scene(8)
    means = splats.means.clone().requires_grad_()
    out = render(replace(splats, means=means), camera, backend="native")
    expanded = torch.ones(()).expand(out.image.shape)
    results = [
        torch.autograd.grad(out.image, means, gradient, retain_graph=True)[0]
        for gradient in (expanded, expanded.contiguous(), torch.ones_like(out.image))
    ]
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_gradient_of_alpha_alone_needs_no_image_gradient(random_scene):
    splats, camera = random_scene(9)

    def gradient(backend, dtype):
        means = splats.means.to(dtype).requires_grad_()
        others = {
            name: getattr(splats, name).to(dtype)
            for name in ("quaternions", "scales", "opacities", "channels")
        }
        out = render(Splats(means=means, **others), camera, backend=backend)
        return torch.autograd.grad(out.alpha.sum(), means)[0]

    expected = gradient("reference", torch.float64)
    assert relative_error(gradient("native", torch.float32), expected) < BOUND


def test_no_gaussians_leave_the_background(camera):
    empty = Splats(
        torch.zeros(1, 0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0),
        torch.zeros(1, 0, 2),
    )  # fmt: skip
    background = torch.tensor([0.25, 0.75], requires_grad=True)
    for backend in ("native", "reference"):
        out = render(empty, camera, background=background, backend=backend)
        assert torch.equal(out.image, background.expand(1, 33, 41, 2))
        assert out.radii.shape == (1, 0)
        (gradient,) = torch.autograd.grad(out.image.sum(), background)
        assert gradient.tolist() == [33 * 41, 33 * 41]


@pytest.mark.parametrize("field", ["means", "quaternions", "scales", "opacities", "linear"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_a_broken_gaussian_is_not_drawn_and_harms_no_other(field, bad, random_scene):
    splats, camera = random_scene(10, linear=True)
    broken = getattr(splats, field).clone()
    broken.view(1, 200, -1)[0, 50] = bad
    gone = splats.opacities.clone()
    gone[0, 50] = 0
    expected = render(replace(splats, opacities=gone), camera, backend="native")
    leaves = replace(splats, **{field: broken})
    means = leaves.means.clone().requires_grad_()
    out = render(replace(leaves, means=means), camera, backend="native")
    if not (field == "opacities" and bad > 0):  # an opacity over 1 is drawn as an opaque one
        if out.radii[0, 50] == 0:
            assert torch.equal(out.image, expected.image)
        else:
            assert field == "quaternions" and bad == 1e38
    (gradient,) = torch.autograd.grad(out.image.sum(), means)
    others = torch.arange(200) != 50
    assert torch.isfinite(gradient[0, others]).all()


def test_gaussians_at_and_behind_the_camera_are_not_drawn(camera):
    depths = torch.tensor([0.0, -1.0, 0.0099, 0.011])
    splats = Splats(
        means=torch.stack([0 * depths, 0 * depths, depths], -1)[None],
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4),
        scales=torch.full((4, 3), 1e-3),
        opacities=torch.full((4,), 0.5),
        channels=torch.ones(1, 4, 1),
    )
    for backend in ("native", "reference"):
        assert (render(splats, camera, backend=backend).radii > 0).tolist() == [[0, 0, 0, 1]]
        assert (render(splats, camera, near=0.5, backend=backend).radii == 0).all()


def test_unusable_requests_say_why(random_scene, monkeypatch):
    splats, camera = random_scene(0, times=2)
    with pytest.raises(BackendError, match="float32"):
        doubles = {
            name: getattr(splats, name).double()
            for name in ("means", "quaternions", "scales", "opacities", "channels")
        }
        render(Splats(**doubles), camera)
    with pytest.raises(BackendError, match="Unknown render backend 'fast'"):
        render(splats, camera, backend="fast")
    with pytest.raises(BackendError, match="meta"):
        names = ("means", "quaternions", "scales", "opacities", "channels")
        render(Splats(**{name: getattr(splats, name).to("meta") for name in names}), camera)
    with pytest.raises(BackendError, match=r"quaternions has shape \(2, 200, 3\)"):
        render(replace(splats, quaternions=splats.quaternions[..., :3]), camera)
    with pytest.raises(
        BackendError, match=r"means has shape \(2, 200, 3\), expected .* T = 1 or 3"
    ):
        render(replace(splats, channels=torch.zeros(3, 200, 3)), camera)
    with pytest.raises(BackendError, match=r"background has shape \(4,\)"):
        render(splats, camera, background=torch.zeros(4))
    with pytest.raises(BackendError, match="opacities is torch.int64"):
        render(replace(splats, opacities=torch.ones(200, dtype=torch.long)), camera)
    with pytest.raises(BackendError, match="K must be"):
        skewed = camera.K.clone()
        skewed[0, 1] = 1
        render(splats, replace(camera, K=skewed))
    with pytest.raises(BackendError, match="0 x 45"):
        render(splats, replace(camera, width=0))
    monkeypatch.setenv("EVSPLAT_ISA", "mmx")
    with pytest.raises(BackendError, match="EVSPLAT_ISA=mmx cannot run here"):
        render(splats, camera)


def test_inputs_changed_before_the_backward_pass_are_refused(random_scene):
    splats, camera = random_scene(1)
    means = splats.means.clone().requires_grad_()
    scales = splats.scales.clone()
    out = render(replace(splats, means=means, scales=scales), camera, backend="native")
    scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.image.sum().backward()
