"""Uniform cubic B-splines in time, and the normal equations of least squares over their knots."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

ORDER = 4
"""Control points that share in the value at one time."""
# Rows: powers 0 to 3 of the place between two knots; columns: the control points about it.
_PIECES = torch.tensor(
    [[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=torch.float64
) / 6  # fmt: skip


@dataclass(frozen=True)
class Weights:
    """Shares of ``ORDER`` neighbouring control points in the values at T times."""

    first: Int64[Tensor, "T"]
    """Index of the first of them."""
    shares: Float[Tensor, "T 4"]

    def of(self, control: Float[Tensor, "K *D"]) -> Float[Tensor, "T *D"]:
        """Values at the times."""
        near = control[self.first[:, None] + torch.arange(ORDER)]
        return torch.einsum("ta,ta...->t...", self.shares, near)


@dataclass(frozen=True)
class UniformSpline:
    """A cubic B-spline with ``count`` control points on knots ``step_s`` apart, from ``start_s``.

    Outside of the knots the ends' pieces are held at the first and the last time.
    """

    start_s: float
    step_s: float
    count: int

    @classmethod
    def over(cls, start_s: float, end_s: float, step_s: float) -> "UniformSpline":
        """Knots from ``start_s`` until the last piece reaches ``end_s``."""
        pieces = max(1, math.ceil((end_s - start_s) / step_s - 1e-9))
        return cls(start_s, step_s, pieces + 3)

    def weights(self, times_s: Float[Tensor, "T"], derivative: int = 0) -> Weights:
        """Weights of value (0), rate per second (1) or acceleration per s^2 (2)."""
        place = (times_s.double() - self.start_s) / self.step_s
        place = place.clamp(0, self.count - 3)
        first = place.floor().clamp(max=self.count - 4)
        u = place - first
        zero, one = torch.zeros_like(u), torch.ones_like(u)
        powers = (
            (one, u, u**2, u**3),
            (zero, one, 2 * u, 3 * u**2),
            (zero, zero, 2 * one, 6 * u),
        )[derivative]
        shares = torch.stack(powers, 1) @ _PIECES / self.step_s**derivative
        return Weights(first.long(), shares)

    def through(
        self, times_s: Float[Tensor, "T"], values: Float[Tensor, "T D"], smooth_s: float = 0.05
    ) -> Float[Tensor, "K D"]:
        """Control points of a smooth curve near ``values``; wobbles below ``smooth_s`` are lost."""
        dense = _dense(self.weights(times_s), self.count)
        knots = self.start_s + self.step_s * torch.arange(self.count - 2, dtype=torch.float64)
        bend = _dense(self.weights(knots, 2), self.count)
        price = smooth_s**4 * len(times_s) / len(knots)
        normal = dense.T @ dense + price * bend.T @ bend
        normal += 1e-12 * torch.eye(self.count, dtype=torch.float64)
        return torch.linalg.solve(normal, dense.T @ values.double())


class NormalEquations:
    """``H`` and ``g`` of a sum of squares: K control points of D numbers each, and E others.

    A time's residuals touch four neighbouring control points, so that H is block-banded with a
    border for the E numbers that all times share.
    """

    def __init__(self, count: int, size: int, shared: int) -> None:
        self.count, self.size, self.shared = count, size, shared
        zeros = lambda *shape: torch.zeros(*shape, dtype=torch.float64)  # noqa: E731
        self.band = zeros(ORDER, count, size, size)
        """[d, k]: block of the control points k and k + d."""
        self.border = zeros(count, size, shared)
        self.corner = zeros(shared, shared)
        self.gradient = zeros(count, size)
        self.shared_gradient = zeros(shared)

    def add(
        self,
        weights: Weights,
        square: Float[Tensor, "T D D"],
        slope: Float[Tensor, "T D"],
        border: Float[Tensor, "T D E"] | None = None,
    ) -> None:
        """Add ``J^T W J``, ``J^T W r`` and the product with the shared columns of each time."""
        shares, first = weights.shares, weights.first
        for a in range(ORDER):
            self.gradient.index_add_(0, first + a, shares[:, a, None] * slope)
            if border is not None:
                self.border.index_add_(0, first + a, shares[:, a, None, None] * border)
            for b in range(a, ORDER):
                both = (shares[:, a] * shares[:, b])[:, None, None] * square
                self.band[b - a].index_add_(0, first + a, both)

    def gram(self, weights: Weights, square: Float[Tensor, "D D"], factor: float) -> None:
        """Add the same quadratic price at all times: its gradient is left to `multiply`."""
        for a in range(ORDER):
            for b in range(a, ORDER):
                both = weights.shares[:, a] * weights.shares[:, b]
                total = torch.zeros(self.count, dtype=torch.float64)
                total.index_add_(0, weights.first + a, both)
                self.band[b - a] += factor * total[:, None, None] * square

    def multiply(self, control: Float[Tensor, "K D"]) -> Float[Tensor, "K D"]:
        """The banded part times ``control``."""
        product = torch.einsum("kij,kj->ki", self.band[0], control)
        for d in range(1, ORDER):
            upper = self.band[d, : self.count - d]
            product[: self.count - d] += torch.einsum("kij,kj->ki", upper, control[d:])
            product[d:] += torch.einsum("kij,ki->kj", upper, control[: self.count - d])
        return product

    def copy(self) -> "NormalEquations":
        """An independent copy."""
        new = NormalEquations.__new__(NormalEquations)
        for name, value in vars(self).items():
            setattr(new, name, value.clone() if isinstance(value, Tensor) else value)
        return new

    def factor(self, damping: float = 0.0) -> "Factor":
        """Cholesky factor of H with its diagonal enlarged by the share ``damping``."""
        return Factor(self, damping)


class Factor:
    """Block-tridiagonal Cholesky factor of `NormalEquations`, for steps and covariances.

    Three control points make one block row, since those further apart do not meet.
    """

    _GROUP = ORDER - 1

    def __init__(self, normal: NormalEquations, damping: float) -> None:
        self._normal = normal
        size, count = normal.size, normal.count
        self._rows = -(-count // self._GROUP)
        diagonal, below = self._grouped(damping)
        self._chol: list[Tensor] = []
        self._lower: list[Tensor] = []
        for row in range(self._rows):
            block = diagonal[row]
            if row:
                lower = torch.linalg.solve_triangular(
                    self._chol[-1], below[row - 1].T, upper=False
                ).T
                self._lower.append(lower)
                block = block - lower @ lower.T
            self._chol.append(torch.linalg.cholesky(block))
        flat = torch.zeros(self._rows * self._GROUP, size, normal.shared, dtype=torch.float64)
        flat[:count] = normal.border
        self._border = flat.reshape(self._rows, -1, normal.shared)
        self._solved = self._solve(self._border)
        corner = normal.corner + damping * torch.diag(normal.corner.diagonal())
        schur = corner - torch.einsum("rie,rif->ef", self._border, self._solved)
        self._schur = torch.linalg.inv(schur) if normal.shared else schur

    def step(self) -> tuple[Float[Tensor, "K D"], Float[Tensor, "E"]]:
        """Minus the solution of ``H x = g``: the step to the minimum."""
        normal = self._normal
        flat = torch.zeros(self._rows * self._GROUP, normal.size, dtype=torch.float64)
        flat[: normal.count] = normal.gradient
        right = flat.reshape(self._rows, -1, 1)
        alone = self._solve(right)
        rest = normal.shared_gradient - torch.einsum("rie,rio->e", self._border, alone)
        shared = self._schur @ rest
        own = alone[..., 0] - torch.einsum("rie,e->ri", self._solved, shared)
        return -own.reshape(-1, normal.size)[: normal.count], -shared

    def covariance(self, weights: Weights) -> Float[Tensor, "T D D"]:
        """Covariance of the curves' values at the times: blocks of the inverse of H.

        By the backward recursion for the inverse within the band (Takahashi et al. 1973), plus what
        the shared numbers' uncertainty adds.
        """
        diagonal, above = self._inverse_blocks()
        size, group = self._normal.size, self._GROUP
        result = torch.zeros(len(weights.first), size, size, dtype=torch.float64)
        for a in range(ORDER):
            for b in range(ORDER):
                i, j = weights.first + a, weights.first + b
                low, high = torch.minimum(i, j), torch.maximum(i, j)
                row, column = low // group, high // group
                same = row == column
                wide = torch.where(
                    same[:, None, None], diagonal[row], above[row.clamp(max=self._rows - 2)]
                )
                blocks = wide.reshape(-1, group, size, group, size)
                index = torch.arange(len(i))
                block = blocks[index, low % group, :, high % group]
                block = torch.where((i <= j)[:, None, None], block, block.mT)
                result += (weights.shares[:, a] * weights.shares[:, b])[:, None, None] * block
        flat = self._solved.reshape(-1, size, self._normal.shared)[: self._normal.count]
        moved = weights.of(flat)
        return result + moved @ self._schur @ moved.mT

    def _grouped(self, damping: float) -> tuple[Tensor, Tensor]:
        """Diagonal blocks (R, 3D, 3D) and the blocks below them (R-1, 3D, 3D)."""
        normal, group = self._normal, self._GROUP
        size, count = normal.size, normal.count
        wide = torch.zeros(2, self._rows, group, size, group, size, dtype=torch.float64)
        for d in range(ORDER):
            for k in range(count - d):
                block = normal.band[d, k]
                r, c = divmod(k, group), divmod(k + d, group)
                if r[0] == c[0]:
                    wide[0, r[0], r[1], :, c[1]] = block
                    wide[0, r[0], c[1], :, r[1]] = block.T
                else:
                    wide[1, r[0], c[1], :, r[1]] = block.T
        for k in range(count, self._rows * group):
            wide[0, -1, k % group, :, k % group] = torch.eye(size, dtype=torch.float64)
        flat = wide.reshape(2, self._rows, group * size, group * size)
        extra = damping * flat[0].diagonal(dim1=-2, dim2=-1)
        return flat[0] + torch.diag_embed(extra), flat[1, :-1]

    def _solve(self, right: Float[Tensor, "R G C"]) -> Float[Tensor, "R G C"]:
        solve = torch.linalg.solve_triangular
        forward: list[Tensor] = []
        for row in range(self._rows):
            value = right[row]
            if row:
                value = value - self._lower[row - 1] @ forward[-1]
            forward.append(solve(self._chol[row], value, upper=False))
        back: list[Tensor] = []
        for row in reversed(range(self._rows)):
            value = forward[row]
            if back:
                value = value - self._lower[row].T @ back[-1]
            back.append(solve(self._chol[row].T, value, upper=True))
        return torch.stack(back[::-1])

    def _inverse_blocks(self) -> tuple[Tensor, Tensor]:
        """Blocks of the inverse on the diagonal (R, ...) and above it (max(R - 1, 1), ...)."""
        diagonal = [torch.cholesky_inverse(self._chol[-1])]
        above: list[Tensor] = []
        for row in reversed(range(self._rows - 1)):
            own = torch.cholesky_inverse(self._chol[row])
            gain = torch.linalg.solve_triangular(self._chol[row].T, self._lower[row].T, upper=True)
            above.append(-gain @ diagonal[-1])
            diagonal.append(own + gain @ diagonal[-1] @ gain.T)
        stacked = torch.stack(diagonal[::-1])
        return stacked, torch.stack(above[::-1]) if above else torch.zeros_like(stacked)


def _dense(weights: Weights, count: int) -> Float[Tensor, "T K"]:
    matrix = torch.zeros(len(weights.first), count, dtype=torch.float64)
    return matrix.scatter_(1, weights.first[:, None] + torch.arange(ORDER), weights.shares)
