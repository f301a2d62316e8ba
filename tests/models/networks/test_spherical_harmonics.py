"""The basis against scipy's complex harmonics, and its orthonormality."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from evsplat.models.networks.spherical_harmonics import sh_basis


def directions(count, seed=0):
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)).double()
    return torch.nn.functional.normalize(points, dim=-1)


def test_basis_is_the_real_form_of_scipys_harmonics():
    points = directions(200)
    polar = np.arccos(points[:, 2].numpy())
    azimuth = np.arctan2(points[:, 1].numpy(), points[:, 0].numpy())
    basis = sh_basis(points, constant=True).numpy()
    column = 0
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            real = (
                value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real)
            )
            assert np.abs(basis[:, column] - real).max() < 1e-12, (degree, order)
            column += 1


def test_basis_is_orthonormal_on_the_sphere():
    """Gauss-Legendre in z times equal steps in longitude integrates degree 6 exactly."""
    z, weights = np.polynomial.legendre.leggauss(8)
    longitude = np.arange(16) * 2 * np.pi / 16
    radius = np.sqrt(1 - z**2)[:, None]
    points = np.stack(
        np.broadcast_arrays(radius * np.cos(longitude), radius * np.sin(longitude), z[:, None]), -1
    ).reshape(-1, 3)
    basis = sh_basis(torch.tensor(points), constant=True).numpy()
    area = np.repeat(weights * 2 * np.pi / 16, 16)
    assert np.abs(basis.T @ (area[:, None] * basis) - np.eye(16)).max() < 1e-12


def test_constant_and_degree_choose_columns():
    points = directions(5)
    whole = sh_basis(points, constant=True)
    for degree in range(4):
        width = (degree + 1) ** 2
        assert torch.equal(sh_basis(points, degree, constant=True), whole[:, :width])
        assert torch.equal(sh_basis(points, degree), whole[:, 1:width])
    assert sh_basis(points).shape == (5, 15)
    with pytest.raises(ValueError, match="expected 0..3"):
        sh_basis(points, 4)


def test_gradient():
    assert torch.autograd.gradcheck(sh_basis, (directions(4).requires_grad_(),))
