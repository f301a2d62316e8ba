"""PSNR and SSIM against scikit-image and closed forms."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from evsplat import _native
from evsplat.similarity.psnr_ssim import (
    GAUSSIAN_SSIM,
    SCIKIT_DEFAULT_SSIM,
    ZERO_PADDED_SSIM,
    Ssim,
    l1_and_ssim,
    psnr,
    psnr_channel_mean,
    ssim,
    ssim_map,
)


def random_pair(seed: int, height: int = 37, width: int = 29) -> tuple[np.ndarray, np.ndarray]:
    """A picture and a distorted one, of odd sizes, values in [0, 1]."""
    rng = np.random.default_rng(seed)
    first = np.clip(rng.random((height, width, 3)) ** rng.uniform(0.5, 3), 0, 1)
    second = np.clip(first + rng.normal(0, rng.uniform(0.01, 0.3), first.shape), 0, 1)
    return first, second


@pytest.mark.parametrize("seed", range(5))
def test_psnr_is_scikit_images(seed):
    first, second = random_pair(seed)
    ours = psnr(torch.from_numpy(second), torch.from_numpy(first))
    assert float(ours) == pytest.approx(
        peak_signal_noise_ratio(first, second, data_range=1.0), abs=1e-10
    )


@pytest.mark.parametrize("seed", range(5))
def test_gaussian_ssim_is_scikit_images(seed):
    first, second = random_pair(seed)
    theirs = structural_similarity(
        first,
        second,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    ours = ssim(torch.from_numpy(second), torch.from_numpy(first), GAUSSIAN_SSIM)
    assert float(ours) == pytest.approx(theirs, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_uniform_ssim_is_scikit_images_default_with_range_two(seed):
    first, second = random_pair(seed)
    theirs = structural_similarity(first, second, data_range=2, channel_axis=-1)
    ours = ssim(torch.from_numpy(second), torch.from_numpy(first), SCIKIT_DEFAULT_SSIM)
    assert float(ours) == pytest.approx(theirs, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_zero_padded_ssim_is_the_valid_one_of_a_picture_with_a_black_frame(seed):
    first, second = (torch.from_numpy(picture) for picture in random_pair(seed))
    framed = [torch.nn.functional.pad(p, (0, 0, 5, 5, 5, 5)) for p in (first, second)]
    expected = ssim(framed[0], framed[1], GAUSSIAN_SSIM)
    assert float(ssim(first, second, ZERO_PADDED_SSIM)) == pytest.approx(float(expected), abs=1e-12)


def test_equal_pictures_have_ssim_one_and_infinite_psnr():
    picture = torch.from_numpy(random_pair(1)[0])
    for settings in (GAUSSIAN_SSIM, SCIKIT_DEFAULT_SSIM, ZERO_PADDED_SSIM):
        assert float(ssim(picture, picture, settings)) == pytest.approx(1.0, abs=1e-12)
    assert math.isinf(float(psnr(picture, picture)))


def test_psnr_of_a_mask_counts_its_pixels_only():
    reference = torch.zeros(4, 4, 3, dtype=torch.float64)
    picture = reference.clone()
    picture[0, 0] = 0.1
    picture[3, 3] = 0.7
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[0, :2] = True
    # mean squared error 0.01 / 2 over two pixels
    assert float(psnr(picture, reference, mask=mask)) == pytest.approx(-10 * math.log10(0.005))


def test_channel_mean_psnr_is_above_the_usual_one_unless_channels_are_alike():
    reference = torch.zeros(3, 3, 3, dtype=torch.float64)
    alike, unlike = reference + 0.1, reference + torch.tensor([0.1, 0.01, 0.2]).double()
    assert float(psnr_channel_mean(alike, reference)) == pytest.approx(20.0)
    by_hand = (20.0 + 40.0 - 20 * math.log10(0.2)) / 3
    assert float(psnr_channel_mean(unlike, reference)) == pytest.approx(by_hand)
    assert psnr_channel_mean(unlike, reference) > psnr(unlike, reference)


def test_data_range_scales_with_the_values():
    first, second = (torch.from_numpy(picture) for picture in random_pair(7))
    scaled = Ssim(data_range=255.0)
    assert float(ssim(first * 255, second * 255, scaled)) == pytest.approx(
        float(ssim(first, second)), abs=1e-12
    )


def test_ssim_has_a_gradient_that_improves_it():
    first, second = (torch.from_numpy(picture) for picture in random_pair(3))
    picture = second.clone().requires_grad_()
    before = ssim(picture, first)
    (gradient,) = torch.autograd.grad(before, picture)
    assert ssim(second + 1e-3 * gradient / gradient.abs().max(), first) > before


@pytest.mark.parametrize(
    "call",
    [
        lambda a, b: psnr(a, b[:-1]),
        lambda a, b: ssim(a, b[:, :-1]),
        lambda a, b: ssim(a[:9], b[:9]),
        lambda a, b: ssim(a, b, Ssim(size=8)),
        lambda a, b: psnr(a, b, mask=torch.zeros(a.shape[:2], dtype=torch.bool)),
    ],
    ids=["psnr shapes", "ssim shapes", "smaller than the window", "even window", "empty mask"],
)
def test_what_is_not_defined_is_refused(call):
    first, second = (torch.from_numpy(picture) for picture in random_pair(0))
    with pytest.raises(ValueError):
        call(first, second)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "shape", [(11, 11, 3), (12, 40, 3), (37, 19, 1), (64, 80, 3), (141, 33, 2)]
)
@pytest.mark.parametrize("level", ["avx512", "avx2", "portable"])
def test_compiled_ssim_and_its_gradient_equal_plain_torch_in_float64(
    seed, shape, level, monkeypatch
):
    if level not in _native.levels():
        pytest.skip(f"this CPU has no {level}")
    monkeypatch.setenv("EVSPLAT_ISA", level)
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(shape, generator=generator)
    reference = (image + 0.1 * torch.randn(shape, generator=generator)).clamp(0, 1)
    fast, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    # Scratch memory is used again: what a broader picture left there must not be read.
    broader = torch.full((16, shape[1] + 24, 3), float("nan"), requires_grad=True)
    ssim(broader, broader.detach()).backward()
    value = ssim(fast, reference)
    expected = ssim_map(exact, reference.double(), GAUSSIAN_SSIM).mean()
    assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
    (gradient,) = torch.autograd.grad(3 * value, fast)
    (truth,) = torch.autograd.grad(3 * expected, exact)
    assert (gradient - truth).norm() < 1e-4 * truth.norm()


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize("shape", [(1, 11, 11), (3, 12, 40), (2, 140, 33), (4, 64, 75)])
@pytest.mark.parametrize("level", ["avx512", "avx2", "portable"])
def test_compiled_means_in_windows_are_those_of_numpy(shape, pad, level, monkeypatch):
    if level not in _native.levels():
        pytest.skip(f"this CPU has no {level}")
    monkeypatch.setenv("EVSPLAT_ISA", level)
    rng = np.random.default_rng(sum(shape) + pad)
    planes, weights = rng.normal(size=shape), rng.random(11)  # no symmetry that hides a mistake
    around = np.pad(planes, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(around, (11, 11), axis=(1, 2))
    expected = np.einsum("cyxij,i,j->cyx", windows, weights, weights)
    means = np.full(expected.shape, np.nan)
    _native.window_means(planes, weights, pad, means, 2)
    np.testing.assert_allclose(means, expected, rtol=0, atol=1e-13)


def test_means_in_windows_refuse_shapes_that_do_not_fit():
    planes, weights = np.zeros((2, 20, 30)), np.full(11, 1 / 11)
    for shape, pad in [((2, 10, 19), 0), ((1, 10, 20), 0), ((2, 10, 20), 5), ((2, 10, 20), 11)]:
        with pytest.raises(ValueError, match="bad shape"):
            _native.window_means(planes, weights, pad, np.zeros(shape), 1)
    with pytest.raises(ValueError, match="bad shape of the window"):
        _native.window_means(planes[:, :9], weights, 0, np.zeros((2, 1, 20)), 1)


@pytest.mark.parametrize("settings", [GAUSSIAN_SSIM, SCIKIT_DEFAULT_SSIM, ZERO_PADDED_SSIM])
def test_compiled_means_leave_the_map_as_plain_torch_has_it(settings, monkeypatch):
    first, second = (torch.from_numpy(picture) for picture in random_pair(4, 70, 45))
    compiled = ssim_map(second, first, settings)
    monkeypatch.setattr("evsplat.similarity.psnr_ssim.native", None)
    plain = ssim_map(second, first, settings)
    # Not bit for bit on every CPU: torch fuses products and sums where it finds AVX2.
    torch.testing.assert_close(compiled, plain, rtol=0, atol=1e-12)
    assert compiled.is_contiguous() and plain.is_contiguous()


def test_compiled_ssim_reads_planar_and_interleaved_pictures_alike():
    generator = torch.Generator().manual_seed(0)
    planar = torch.rand(3, 30, 20, generator=generator).permute(1, 2, 0)
    reference = torch.rand(30, 20, 3, generator=generator)
    assert float(ssim(planar, reference)) == float(ssim(planar.contiguous(), reference))
    assert float(ssim(planar, planar)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_difference_and_similarity_share_one_gradient(seed):
    generator = torch.Generator().manual_seed(seed)
    image, reference = (torch.rand(75, 31, 3, generator=generator) for _ in range(2))
    image[:4] = reference[:4]  # equal pixels have no gradient of the absolute difference
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = image.to(dtype).requires_grad_()
        l1, similarity = l1_and_ssim(leaf, reference.to(dtype))
        (gradient,) = torch.autograd.grad(0.8 * l1 - 0.2 * similarity, leaf)
        results.append((l1, similarity, gradient))
    for compiled, plain in zip(*results, strict=True):
        assert (compiled - plain).norm() < 2e-6 * plain.norm()


def test_a_second_gradient_of_the_same_ssim_is_refused():
    image = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(3)).requires_grad_()
    value = sum(l1_and_ssim(image, torch.zeros(20, 30, 3)))
    torch.autograd.grad(value, image, retain_graph=True)
    with pytest.raises(RuntimeError, match="asked for twice"):
        torch.autograd.grad(value, image)


@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_in_plain_torch_is_that_of_autograd_through_the_map(seed):
    first, second = (torch.from_numpy(picture) for picture in random_pair(seed))
    second.requires_grad_()
    values = l1_and_ssim(second, first)
    expected = (second - first).abs().mean(), ssim_map(second, first, GAUSSIAN_SSIM).mean()
    gradients = []
    for l1, similarity in (values, expected):
        gradients += torch.autograd.grad(0.8 * l1 - 0.2 * similarity, second)
    for value, wanted in zip((*values, gradients[0]), (*expected, gradients[1]), strict=True):
        assert torch.allclose(value, wanted, atol=1e-14, rtol=1e-10)
