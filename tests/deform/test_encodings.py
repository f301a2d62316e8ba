"""Encodings against literal loops, closed forms and finite differences."""

import math
from copy import deepcopy
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from evsplat.deform import HashGridEncoding, OneBlobEncoding, make_encoding


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


def hash_grid_loop(grid, position):
    """Instant-NGP, corner by corner."""
    values = []
    for level, cells in enumerate(grid.resolutions):
        start, stop = grid.offsets[level : level + 2]
        scaled = [min(max(float(p), 0.0), 1.0) * cells for p in position]
        low = [min(math.floor(s), cells - 1) for s in scaled]
        total = np.zeros(grid.features)
        for corner in range(8):
            bits = [(corner >> axis) & 1 for axis in range(3)]
            x, y, z = (low[axis] + bits[axis] for axis in range(3))
            share = math.prod(
                scaled[axis] - low[axis] if bits[axis] else 1 - (scaled[axis] - low[axis])
                for axis in range(3)
            )
            if (cells + 1) ** 3 == stop - start:
                entry = x + (cells + 1) * (y + (cells + 1) * z)
            else:
                hashed = (x ^ (y * 2654435761) ^ (z * 805459861)) & 0xFFFFFFFF
                entry = hashed % (stop - start)
            total += share * grid.table[start + entry].detach().numpy()
        values.extend(total)
    return values


@pytest.mark.parametrize("seed", range(3))
def test_hash_grid_equals_the_loop_over_corners(seed):
    torch.manual_seed(seed)
    grid = HashGridEncoding(levels=6, features=2 + seed, log2_table=9, base=4, finest=200).double()
    torch.nn.init.normal_(grid.table)
    positions = torch.rand(40, 3, dtype=torch.float64) * 1.1 - 0.05
    positions[0], positions[1] = 0.0, 1.0
    encoded = grid(positions.view(4, 10, 3)).view(40, -1)
    expected = torch.tensor(np.array([hash_grid_loop(grid, position) for position in positions]))
    assert encoded.shape == (40, grid.dim)
    assert (encoded - expected).abs().max() < 1e-12


def test_default_hash_grid_has_the_configured_levels():
    grid = make_encoding("hashgrid")
    assert grid.dim == 32 and grid.resolutions[0] == 16 and grid.resolutions[-1] == 2048
    assert all(abs(after / before - 1.3819) < 0.06 for before, after in pairwise(grid.resolutions))
    sizes = np.diff(grid.offsets)
    assert sizes[0] == 17**3 and sizes[-1] == 2**16 and len(grid.table) == sizes.sum()
    assert 0 < grid.table.abs().max() <= 1e-4


def test_hash_grid_gradients_to_table_and_positions():
    torch.manual_seed(0)
    grid = HashGridEncoding(levels=3, features=2, log2_table=5, base=2, finest=9).double()
    torch.nn.init.normal_(grid.table)
    positions = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, table: grid(p), (positions, grid.table))


@pytest.mark.parametrize(("seed", "features", "points"), [(0, 2, 1000), (1, 2, 37), (2, 3, 16)])
def test_native_values_and_gradients_equal_those_in_float64(seed, features, points):
    torch.manual_seed(seed)
    grid = HashGridEncoding(features=features, log2_table=12)
    torch.nn.init.normal_(grid.table)
    # Few bits, so that float32 finds the same cell on every level; the slope jumps between cells.
    positions = (torch.randint(-200, 4300, (points, 3)) + 0.5) / 4096
    upstream = torch.randn(points, grid.dim)
    results = []
    for precise in (False, True):
        copy = deepcopy(grid).double() if precise else grid
        here = positions.to(copy.table.dtype).requires_grad_()
        encoded = copy(here)
        gradients = torch.autograd.grad(encoded, (here, copy.table), upstream.to(encoded.dtype))
        results.append((encoded, *gradients))
    for name, (value, expected) in zip(
        ("encoding", "positions", "table"), zip(*results, strict=True), strict=True
    ):
        error = ((value - expected).norm() / expected.norm()).item()
        assert error < 1e-6, (name, error)


def test_native_results_do_not_depend_on_the_number_of_threads():
    torch.manual_seed(3)
    grid = HashGridEncoding()
    torch.nn.init.normal_(grid.table)
    positions, upstream = torch.rand(5000, 3), torch.randn(5000, grid.dim)
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        here = positions.clone().requires_grad_()
        encoded = grid(here)
        gradients = torch.autograd.grad(encoded, (here, grid.table), upstream)
        results.append((encoded, *gradients))
    torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_positions_that_are_no_number_stay_inside_the_table():
    grid = HashGridEncoding()
    encoded = grid(torch.tensor([[float("nan"), 0.5, 0.5], [0.5, 0.5, 0.5]]))
    assert encoded[0].isnan().all() and encoded[1].isfinite().all()


def test_gradients_of_one_input_do_not_need_the_other():
    grid = HashGridEncoding(levels=2, log2_table=6, base=2, finest=4)
    grid(torch.rand(4, 3)).sum().backward()
    assert grid.table.grad.abs().sum() > 0
    grid.table.requires_grad_(False)
    positions = torch.rand(4, 3, requires_grad=True)
    grid(positions).sum().backward()
    assert positions.grad is not None


def test_unknown_encoding_is_refused():
    with pytest.raises(ValueError, match="encoding 'blob' is unknown"):
        make_encoding("blob")
