"""Transfer curves against the standard and against each other."""

import pytest
import torch
from skimage.color import rgb2gray

from evsplat.imaging import decode, encode, luminance


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
