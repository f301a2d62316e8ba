"""One-blob encoding against literal loops, closed forms and finite differences."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from evsplat.models.networks.non_rigid import OneBlobEncoding


def quartic_cdf(x, inverse_radius):
    """tiny-cuda-nn's: a quartic kernel integrated up to x, clamped."""
    u = x * inverse_radius
    return min(max(15 / 16 * u * (1 - 2 / 3 * u**2 + 1 / 5 * u**4) + 0.5, 0.0), 1.0)


def one_blob_loop(x, bins):
    """tiny-cuda-nn's one-blob of one coordinate: wrapped kernel, bin by bin."""

    def cdf(edge):
        return sum(quartic_cdf(edge - x + shift, bins) for shift in (0, -1, 1))

    return [cdf((k + 1) / bins) - cdf(k / bins) for k in range(bins)]


@pytest.mark.parametrize("bins", [4, 16])
def test_one_blob_equals_the_loop_over_bins(bins):
    x = np.concatenate((np.random.default_rng(0).random(60), [0, 1, 0.5, 1 / bins, 0.999999]))
    encoding = OneBlobEncoding(bins)
    positions = torch.tensor(x).reshape(-1, 1).expand(-1, 3)
    encoded = encoding(positions).reshape(-1, 3, bins)
    expected = torch.tensor(np.array([one_blob_loop(float(value), bins) for value in x]))
    assert encoding.dim == 3 * bins
    for axis in range(3):
        assert (encoded[:, axis] - expected).abs().max() < 1e-12


def test_one_blob_integrates_the_quartic_kernel():
    x, bins = 0.437, 16
    encoded = OneBlobEncoding(bins)(torch.tensor([[x, 0.1, 0.9]], dtype=torch.float64))[0, :bins]
    for k in range(bins):
        area, _ = quad(
            lambda v: bins * 15 / 16 * max(1 - ((v - x) * bins) ** 2, 0) ** 2,
            k / bins,
            (k + 1) / bins,
        )
        assert abs(encoded[k].item() - area) < 1e-8


def test_one_blob_sums_to_one_per_axis_and_clamps():
    positions = torch.rand(50, 3) * 1.4 - 0.2
    encoded = OneBlobEncoding()(positions)
    assert torch.allclose(encoded.view(50, 3, 16).sum(-1), torch.ones(50, 3), atol=1e-6)
    assert torch.equal(encoded, OneBlobEncoding()(positions.clamp(0, 1)))


def test_one_blob_gradient():
    positions = torch.rand(6, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(OneBlobEncoding(), (positions,))


@pytest.mark.parametrize("bins", [3, 16])
def test_compiled_one_blob_equals_float64(bins):
    drawn = torch.rand(2, 2_100, 3, generator=torch.Generator().manual_seed(bins)) * 1.4 - 0.2
    edges = torch.tensor([0.0, 1.0, 0.5, 1 / bins, -0.0, 1.5])
    positions = torch.cat((drawn.flatten(), edges)).reshape(-1, 3)
    upstream = torch.randn(len(positions), 3 * bins)
    found = []
    for dtype in (torch.float32, torch.float64):
        leaf = positions.to(dtype).requires_grad_()
        encoded = OneBlobEncoding(bins)(leaf)
        found.append((encoded, *torch.autograd.grad(encoded, leaf, upstream.to(dtype))))
    (encoded, gradient), (expected, slope) = found
    assert encoded.dtype == torch.float32
    assert (encoded - expected).abs().max() < 1e-6
    # A coordinate has 24 bits before it is scaled by the bins, and the slope is scaled once more.
    assert (gradient - slope).abs().max() < 1e-5 * bins


def test_compiled_one_blob_says_no_number_where_there_is_none():
    encoded = OneBlobEncoding(4)(torch.tensor([[float("nan"), 0.3, 0.9]])).view(3, 4)
    assert encoded[0].isnan().any() and not encoded[1:].isnan().any()
