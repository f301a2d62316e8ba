"""Transfer curves against the standard, log brightness against its definition; gradients."""

import pytest
import torch
from skimage.color import rgb2gray

from evsplat.pictures import (
    CodedPictures,
    decode,
    encode,
    log_brightness,
    log_brightness_change,
    luminance,
)


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
@pytest.mark.parametrize("seed", range(3))
def test_encode_undoes_decode(transfer, seed):
    values = torch.rand(1000, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert torch.allclose(encode(decode(values, transfer), transfer), values, atol=1e-6)


def test_srgb_curve_has_the_standards_values():
    # IEC 61966-2-1: the linear toe, the knee, and mid grey.
    coded = torch.tensor([0.0, 0.02, 0.04045, 0.5, 1.0], dtype=torch.float64)
    linear = torch.tensor([0.0, 0.00154799, 0.00313080, 0.21404114, 1.0], dtype=torch.float64)
    assert torch.allclose(decode(coded, "srgb"), linear, atol=1e-7)


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_gradients_are_finite_at_black(transfer):
    black = torch.zeros(3, requires_grad=True)
    decode(black, transfer).sum().backward()
    assert black.grad is not None and bool(black.grad.isfinite().all())


def test_luminance_is_rec_709(seed=0):
    pixels = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(seed))
    peer = torch.from_numpy(rgb2gray(pixels.numpy()))  # scikit-image: 0.2125, 0.7154, 0.0721
    assert torch.allclose(luminance(pixels), peer, atol=3e-4)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_power_and_its_gradient_equal_the_definition_in_float64(seed):
    coded = 1.4 * torch.rand(7, 61, generator=torch.Generator().manual_seed(seed)) - 0.2
    leaf = coded.clone().requires_grad_()
    value = decode(leaf)
    (gradient,) = torch.autograd.grad(value.sum(), leaf)
    exact = coded.double().clamp_min(0)
    assert (value - exact**2.2).abs().max() < 1e-6
    assert (gradient - 2.2 * exact**1.2).abs().max() < 2e-6


def by_definition(rgb, eps):
    return torch.log(luminance(decode(rgb.clamp_min(1 / 255), "power")) + eps)


@pytest.mark.parametrize("seed", range(3))
def test_value_and_gradient_are_those_of_the_definition(seed):
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(9, 7, 3, generator=generator, dtype=torch.float64)
    rgb[0], rgb[1, 0] = 0.0, torch.tensor([0.5, 1e-3, -0.2], dtype=torch.float64)
    upstream = torch.randn(9, 7, generator=generator, dtype=torch.float64)
    results = []
    for function in (lambda x: log_brightness(x, eps=1e-3), lambda x: by_definition(x, 1e-3)):
        leaf = rgb.clone().requires_grad_()
        value = function(leaf)
        results.append((value, *torch.autograd.grad(value, leaf, upstream)))
    for fused, plain in zip(*results, strict=True):
        assert torch.allclose(fused, plain, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("planar", [False, True])
def test_compiled_value_and_gradient_equal_the_definition_in_float64(seed, planar):
    generator = torch.Generator().manual_seed(seed)
    rgb = 1.2 * torch.rand(61, 47, 3, generator=generator) - 0.1
    rgb[0], rgb[1] = 0.0, torch.tensor([1e-3, 1.0, 0.5])
    if planar:
        rgb = rgb.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    upstream = torch.randn(61, 47, generator=generator)
    leaf = rgb.clone().requires_grad_()
    value = log_brightness(leaf, eps=1e-5)
    (gradient,) = torch.autograd.grad(value, leaf, upstream)
    leaf = rgb.double().requires_grad_()
    expected = by_definition(leaf, 1e-5)
    (expected_gradient,) = torch.autograd.grad(expected, leaf, upstream.double())
    assert (value - expected).abs().max() < 2e-6
    assert torch.allclose(gradient.double(), expected_gradient, rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("eps", [1e-5, 1e-3])
@pytest.mark.parametrize("planar", [False, True])
def test_the_compiled_change_and_its_gradients_are_those_of_two_logarithms(planar, eps):
    generator = torch.Generator().manual_seed(4)
    pictures = 1.2 * torch.rand(2, 61, 47, 3, generator=generator) - 0.1
    if planar:
        pictures = pictures.permute(0, 3, 1, 2).contiguous().permute(0, 2, 3, 1)
    upstream = torch.randn(61, 47, generator=generator)

    def apart(before, after):
        return log_brightness(after, eps=eps) - log_brightness(before, eps=eps)

    results = []
    for function in (lambda a, b: log_brightness_change(a, b, eps=eps), apart):
        leaves = [picture.clone().requires_grad_() for picture in pictures]
        value = function(*leaves)
        results.append((value, *torch.autograd.grad(value, leaves, upstream)))
    for together, each in zip(*results, strict=True):
        assert torch.equal(together, each)


def test_gradcheck_of_the_change():
    before, after = (
        (0.1 + 0.9 * torch.rand(4, 5, 3, dtype=torch.float64)).requires_grad_() for _ in range(2)
    )
    assert torch.autograd.gradcheck(log_brightness_change, (before, after))


def test_a_doubled_luminance_changes_the_logarithm_by_ln_2():
    rgb = 0.2 + 0.3 * torch.rand(6, 6, 3, dtype=torch.float64)
    brighter = rgb * 2 ** (1 / 2.2)
    change = log_brightness_change(rgb, brighter, eps=0.0)
    assert (change - torch.log(torch.tensor(2.0, dtype=torch.float64))).abs().max() < 1e-12


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize(
    "function", [CodedPictures.mean_light, lambda pictures: pictures.log_luminance(0.004)]
)
def test_compiled_light_of_pictures_and_its_gradient_equal_the_definition_in_float64(
    function, planar
):
    coded = torch.rand(3, 7, 9, 3, generator=torch.Generator().manual_seed(0)) - 0.1
    coded[0, 0] = 0.0
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = (coded.movedim(-1, 1) if planar else coded).to(dtype).contiguous().requires_grad_()
        value = function(CodedPictures((leaf.movedim(1, -1) if planar else leaf).unbind(0)))
        weights = torch.arange(value.numel(), dtype=dtype).view(value.shape).cos()
        results.append((value, *torch.autograd.grad((value * weights).sum(), leaf)))
    for compiled, plain in zip(*results, strict=True):
        assert (compiled - plain).abs().max() < 2e-6 * plain.abs().max()


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_gradient_that_keeps_the_hue_is_that_of_the_channels_mean_logarithm(transfer):
    eps = 0.004
    coded = torch.rand(3, 7, 9, 3, generator=torch.Generator().manual_seed(1)) - 0.05
    coded[0, 0] = 0.0
    upstream = torch.arange(3 * 7 * 9.0).view(3, 7, 9).cos()
    exact = coded.double().requires_grad_()
    logs = torch.log(decode(exact, transfer) + eps).mean(-1)
    (expected,) = torch.autograd.grad((logs * upstream).sum(), exact)
    # The compiled module takes the power curve in single precision alone.
    for dtype in (torch.float32, torch.float64):
        leaf = coded.to(dtype).requires_grad_()
        pictures = CodedPictures(leaf.unbind(0), transfer)
        value = pictures.log_luminance(eps, keeps_hue=True)
        assert torch.equal(value, pictures.log_luminance(eps))
        (gradient,) = torch.autograd.grad(value, leaf, upstream.to(dtype))
        assert (gradient - expected).abs().max() < 2e-6 * expected.abs().max()


def test_a_step_along_the_gradient_that_keeps_the_hue_keeps_the_ratios_of_light():
    logs = torch.randn(4, 6, 3, dtype=torch.float64, requires_grad=True)
    pictures = CodedPictures(encode(logs.exp(), "linear")[:, None].unbind(0), "linear")
    for keeps_hue in (True, False):
        value = pictures.log_luminance(0.0, keeps_hue=keeps_hue)
        (step,) = torch.autograd.grad(value.sum(), logs, retain_graph=True)
        # Either way a step that is the same for all channels is one of the whole luminance.
        assert torch.allclose(step.sum(-1), torch.ones(4, 6, dtype=torch.float64))
        assert (float((step - step.mean(-1, keepdim=True)).abs().max()) < 1e-12) == keeps_hue


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
def test_light_of_pictures_by_other_curves(transfer):
    coded = torch.rand(3, 4, 5, 3)
    linear = decode(coded, transfer)
    pictures = CodedPictures(coded.unbind(0), transfer)
    assert torch.allclose(pictures.mean_light(), linear.mean(0))
    assert torch.allclose(pictures.log_luminance(0.01), torch.log(luminance(linear) + 0.01))
