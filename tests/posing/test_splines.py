"""Uniform cubic B-splines and their normal equations, against polynomials and dense algebra."""

import torch

from evsplat.posing.splines import ORDER, NormalEquations, UniformSpline, Weights


def _dense(weights: Weights, count: int) -> torch.Tensor:
    matrix = torch.zeros(len(weights.first), count, dtype=torch.float64)
    for row, (first, shares) in enumerate(zip(weights.first, weights.shares, strict=True)):
        matrix[row, first : first + ORDER] = shares
    return matrix


def test_a_cubic_polynomial_and_its_derivatives_are_reproduced():
    spline = UniformSpline.over(1.0, 2.0, 0.3)
    times = torch.linspace(1.0, 2.0, 40, dtype=torch.float64)
    values = lambda t: torch.stack((t**3 - t, 2 * t**2), -1)  # noqa: E731
    control = spline.through(times, values(times), smooth_s=0)
    torch.testing.assert_close(spline.weights(times).of(control), values(times), rtol=0, atol=1e-6)
    rate = torch.stack((3 * times**2 - 1, 4 * times), -1)
    torch.testing.assert_close(spline.weights(times, 1).of(control), rate, rtol=0, atol=1e-4)
    bend = torch.stack((6 * times, torch.full_like(times, 4)), -1)
    torch.testing.assert_close(spline.weights(times, 2).of(control), bend, rtol=0, atol=1e-2)


def _random_problem(count: int, size: int = 2, shared: int = 3, times: int = 60):
    generator = torch.Generator().manual_seed(count)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    spline = UniformSpline(0.0, 1.0, count)
    weights = spline.weights(torch.linspace(0, count - 3, times, dtype=torch.float64))
    rates, rates_shared, errors = draw(times, 5, size), draw(times, 5, shared), draw(times, 5)
    normal = NormalEquations(count, size, shared)
    slope = torch.einsum("tri,tr->ti", rates, errors)
    normal.add(weights, rates.mT @ rates, slope, rates.mT @ rates_shared)
    normal.corner += (rates_shared.mT @ rates_shared).sum(0)
    normal.shared_gradient += torch.einsum("tri,tr->i", rates_shared, errors)
    normal.gram(weights, torch.eye(size, dtype=torch.float64), 0.5)
    jacobian = torch.einsum("tk,tri->trki", _dense(weights, count), rates).reshape(-1, count * size)
    jacobian = torch.cat((jacobian, rates_shared.reshape(-1, shared)), 1)
    extra = torch.kron(
        _dense(weights, count).T @ _dense(weights, count), torch.eye(size, dtype=torch.float64)
    )
    matrix = jacobian.T @ jacobian
    matrix[: count * size, : count * size] += 0.5 * extra
    return normal, weights, matrix, jacobian.T @ errors.flatten()


def test_the_step_solves_the_dense_normal_equations():
    for count in (4, 7, 9, 11):
        normal, _, matrix, gradient = _random_problem(count)
        control, shared = normal.factor().step()
        expected = -torch.linalg.solve(matrix, gradient)
        found = torch.cat((control.flatten(), shared))
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


def test_the_covariance_is_that_of_the_dense_inverse():
    normal, weights, matrix, _ = _random_problem(8)
    inverse = torch.linalg.inv(matrix)[:16, :16].reshape(8, 2, 8, 2)
    dense = _dense(weights, 8)
    expected = torch.einsum("tk,kilj,tl->tij", dense, inverse, dense)
    torch.testing.assert_close(normal.factor().covariance(weights), expected)


def test_the_banded_product_is_the_dense_one():
    normal, _, matrix, _ = _random_problem(8)
    control = torch.arange(16, dtype=torch.float64).reshape(8, 2)
    expected = (matrix[:16, :16] @ control.flatten()).reshape(8, 2)
    torch.testing.assert_close(normal.multiply(control), expected)
