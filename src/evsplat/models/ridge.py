"""Ridge regression on splines, in time and memory that grow with the number of times alone."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import splu

from evsplat.models.pose_spline import PoseSpline


class Ridge:
    """The K unknowns c of splines, minimising ``|D c - g|^2 + misfit^2 |c|^2``.

    Spline weights are ``D = S - 1 m^T``: S has four numbers in each row and spline, and m are the
    means that are taken off. So ``D^T D`` is the banded ``S^T S`` and two outer products, whose
    inverse is that of the first put right (Woodbury 1950).
    """

    def __init__(
        self,
        splines: Sequence[tuple[PoseSpline, float]],
        times_us: Sequence[int],
        misfit: float,
    ) -> None:
        """``splines``: that add up, and what each is multiplied by."""
        parts = [(factor, *spline.design(times_us)) for spline, factor in splines]
        self._local = sparse.hstack([factor * local for factor, local, _ in parts], format="csr")
        self._mean = np.concatenate([factor * mean for factor, _, mean in parts])
        columns = self._local.shape[1]
        banded = self._local.T @ self._local + misfit**2 * sparse.eye_array(columns)
        # Symmetric and positive definite: no pivoting, which would fill the band.
        self._banded = splu(
            banded.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        )
        sums = self._local.sum(0)
        # D^T D = S^T S + W C W^T with W = (-m, sums) and C = ((T, 1), (1, 0)).
        self._outer = np.stack([-self._mean, sums], 1)
        inverse = np.array([[0.0, 1.0], [1.0, -len(times_us)]])
        self._solved = self._banded.solve(self._outer)
        self._put_right = np.linalg.inv(inverse + self._outer.T @ self._solved)

    def solve(self, goal: Float[np.ndarray, "T C"]) -> Float[np.ndarray, "K C"]:
        """The unknowns for values at the times."""
        # In place where it can be: of an hour's poses each of these is 50 MB.
        found = self._local.T @ goal
        found -= self._mean[:, None] * goal.sum(0)
        found = self._banded.solve(found)
        found -= self._solved @ (self._put_right @ (self._outer.T @ found))
        return found

    def values(self, unknowns: Float[np.ndarray, "K C"]) -> Float[np.ndarray, "T C"]:
        """Values of the splines at the times."""
        return self._local @ unknowns - self._mean @ unknowns
