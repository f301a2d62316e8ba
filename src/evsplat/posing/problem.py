"""The price of a motion, and its descent by Gauss-Newton steps over all times at once.

The price of a motion is a mean over time of: how far landmarks lie from where the pose puts them
(robust, in their standard deviations), how far their depths are from the detector's own, how
unusual the pose is (`evsplat.posing.prior`), accelerations, and knees or elbows bent backwards.
Since it is close to a sum of squares, and a time touches only four control points of each curve,
the whole motion is solved for at once (`evsplat.posing.splines.NormalEquations`), and the inverse
of the same matrix is the covariance of what was found.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.posing.evidence import Evidence
from evsplat.posing.kinematics import PLACE, SIX, SIZE, TURNS, Posed, pose, row_slice
from evsplat.posing.prior import HINGES, PosePrior
from evsplat.posing.rig import Rig
from evsplat.posing.splines import NormalEquations, UniformSpline, Weights

GRID_S = 0.02
"""Spacing of the times at which motion and pose have their price."""
_ENOUGH = 2e-4


@dataclass(frozen=True)
class FitSettings:
    """Prices of a fit; the defaults were chosen on staged captures of one character."""

    knot_s: float = 0.04
    """Time between control points."""
    depth: float = 0.3
    """Weight of the detector's depths."""
    depth_m: float = 0.08
    """Their standard deviation, metres."""
    prior: float = 1.0
    """Weight of the pose prior."""
    calm: float = 10.0
    """Weight of accelerations."""
    shape: float = 0.2
    """Weight of squared shape coefficients."""
    height_m: float | None = None
    """Known stature, crown to sole."""
    independent_s: float = 0.4
    """Time after which a detector's errors are new: it divides the covariance."""


_TURN_RAD, _PLACE_M, _SIX = 60.0, 15.0, 40.0
"""Accelerations that cost 1: rad/s^2 of a row, m/s^2 of the root, 1/s^2 of the six numbers."""
_STATURE_M = 0.01
_SCALE_PRICE = 40.0
"""Price of the squared logarithm of the detector's scale against the body's."""
_HINGE_PRICE, _UNIT_PRICE = 100.0, 10.0


@dataclass(frozen=True)
class State:
    """A motion and what is the same at all times."""

    control: Float[Tensor, "K S"]
    shared: Float[Tensor, "B+1"]
    """Shape coefficients, then the logarithm of the scale of the detector's depths."""

    @property
    def betas(self) -> Float[Tensor, "B"]:
        """Shape coefficients."""
        return self.shared[:-1]


@dataclass(frozen=True, eq=False)
class Problem:
    """All that a motion's price depends on."""

    rig: Rig
    prior: PosePrior
    evidence: Evidence
    spline: UniformSpline
    settings: FitSettings
    blunt: float = 1.0
    """Factor on the landmarks' standard deviations; more lets a first guess come nearer."""
    _kept: dict = field(default_factory=dict)

    def state(
        self, times: Float[Tensor, "N"], root: Float[Tensor, "N 3 3"], place: Float[Tensor, "N 3"]
    ) -> State:
        """The mean pose on a first guess of the trunk at some times (s)."""
        control = torch.zeros(self.spline.count, SIZE, dtype=torch.float64)
        control[:, SIX] = self.spline.through(times, root[:, :2].flatten(1))
        control[:, PLACE] = self.spline.through(times, place)
        control[:, TURNS] = self.prior.mean
        return State(control, torch.zeros(len(self.rig.growth) + 1, dtype=torch.float64))

    def blunted(self, factor: float) -> "Problem":
        """The same with landmarks that are trusted less."""
        return replace(self, blunt=factor * self.blunt, _kept={})

    def with_evidence(self, evidence: Evidence) -> "Problem":
        """The same with other evidence."""
        return replace(self, evidence=evidence, _kept={})

    def away(self, posed: Posed) -> Float[Tensor, "T 3"]:
        """Direction of depth at a posed person."""
        return torch.nn.functional.normalize(posed.joints[:, 0] - self.centre, dim=-1)

    @property
    def independent_pictures(self) -> float:
        """How many pictures' worth of independent landmarks there are."""
        span = (self.spline.count - 3) * self.spline.step_s
        return max(1.0, span / self.settings.independent_s)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """Mean optical centre in the world."""
        return self.evidence.centres().mean(0)

    @property
    def seen(self) -> Weights:
        """Weights of the control points at the pictures' times."""
        return self._once("seen", lambda: self.spline.weights(self.evidence.times_s))

    @property
    def grid_s(self) -> Float[Tensor, "G"]:
        """Times at which motion and pose have their price."""
        span = (self.spline.count - 3) * self.spline.step_s
        count = max(2, math.ceil(span / GRID_S) + 1)
        return self.spline.start_s + torch.linspace(0, span, count, dtype=torch.float64)

    @property
    def grid(self) -> Weights:
        """Weights at those times."""
        return self._once("grid", lambda: self.spline.weights(self.grid_s))

    def price(self, state: State) -> float:
        """What the motion costs."""
        return self._pictures(state, None) + self._motion(state, None)

    def linearised(self, state: State) -> tuple[float, NormalEquations]:
        """The price, and its Gauss-Newton approximation about the state."""
        normal = self._once("fixed", self._fixed).copy()
        total = self._motion(state, normal)
        return total + self._pictures(state, normal), normal

    def _once(self, name: str, make):
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]

    def posed(self, state: State) -> Posed:
        """The rig at the pictures' times."""
        return pose(self.rig, self.seen.of(state.control), state.betas)

    def _pictures(self, state: State, normal: NormalEquations | None) -> float:
        posed = self.posed(state)
        prices = {
            "depth": self.settings.depth,
            "depth_m": self.settings.depth_m,
            "blunt": self.blunt,
        }
        if normal is None:
            return float(self.evidence.price(posed, state.shared[-1], **prices).mean())
        terms = self.evidence.terms(self.rig, posed, state.shared[-1], **prices)
        normal.add(self.seen, terms.square, terms.slope, terms.border)
        normal.corner += terms.corner
        normal.shared_gradient += terms.shared_slope
        return terms.price

    def _motion(self, state: State, normal: NormalEquations | None) -> float:
        fixed = self._once("fixed", self._fixed)
        bent = fixed.multiply(state.control)
        total = 0.5 * float((state.control * bent).sum()) + float(
            (state.control * fixed.gradient).sum()
        )
        mean, precision = self.prior.mean, self.prior.precision
        total += 0.5 * self.settings.prior * float(mean @ precision @ mean)
        shape, pull = self._shape(state)
        if normal is not None:
            normal.gradient += bent
            normal.corner += shape
            normal.shared_gradient += pull
        total += 0.5 * float(self._shape_price(state))
        return total + self._limits(state, normal)

    def _fixed(self) -> NormalEquations:
        """Prices that are quadratic in the control points: pose prior and accelerations."""
        settings, count = self.settings, len(self.grid_s)
        normal = NormalEquations(self.spline.count, SIZE, len(self.rig.growth) + 1)
        pull = torch.zeros(SIZE, SIZE, dtype=torch.float64)
        pull[TURNS, TURNS] = settings.prior * self.prior.precision
        normal.gram(self.grid, pull, 1 / count)
        slope = -settings.prior * self.prior.precision @ self.prior.mean / count
        for a in range(self.grid.shares.shape[1]):
            flat = torch.zeros(len(self.grid.first), SIZE, dtype=torch.float64)
            flat[:, TURNS] = self.grid.shares[:, a, None] * slope
            normal.gradient.index_add_(0, self.grid.first + a, flat)
        calm = torch.zeros(SIZE, dtype=torch.float64)
        calm[SIX], calm[PLACE], calm[TURNS] = 0.4 / _SIX**2, 0.4 / _PLACE_M**2, 0.2 / _TURN_RAD**2
        bends = self.spline.weights(self.grid_s, 2)
        normal.gram(bends, torch.diag(calm), settings.calm / count)
        return normal

    def _shape(self, state: State) -> tuple[Tensor, Tensor]:
        weight = torch.full_like(state.shared, self.settings.shape)
        weight[-1] = _SCALE_PRICE
        square, slope = torch.diag(weight), weight * state.shared
        if self.settings.height_m is not None:
            rate = torch.cat((self.rig.growth, torch.zeros(1, dtype=torch.float64))) / _STATURE_M
            square = square + torch.outer(rate, rate)
            slope = slope + rate * self._stature_error(state)
        return square, slope

    def _shape_price(self, state: State) -> Tensor:
        total = self.settings.shape * state.betas.square().sum()
        total = total + _SCALE_PRICE * state.shared[-1] ** 2
        if self.settings.height_m is not None:
            total = total + self._stature_error(state) ** 2
        return total

    def _stature_error(self, state: State) -> Tensor:
        """In standard deviations."""
        stature = self.rig.stature + self.rig.growth @ state.betas
        assert self.settings.height_m is not None
        return (stature - self.settings.height_m) / _STATURE_M

    def _limits(self, state: State, normal: NormalEquations | None) -> float:
        """Hinges bent backwards, and the six numbers' distance from two unit vectors."""
        vectors = self.grid.of(state.control)
        count = len(vectors)
        square = vectors.new_zeros(count, SIZE, SIZE)
        slope = vectors.new_zeros(count, SIZE)
        total = vectors.new_zeros(())
        for name, axis in HINGES.items():
            direction = torch.tensor(axis, dtype=torch.float64)
            direction = direction / direction.norm()
            columns = row_slice(name)
            over = (self.prior.lowest[name] - vectors[:, columns] @ direction).clamp_min(0)
            total = total + _HINGE_PRICE / 2 * over.square().sum()
            slope[:, columns] -= _HINGE_PRICE * over[:, None] * direction
            active = (over > 0).double()[:, None, None]
            square[:, columns, columns] += _HINGE_PRICE * active * torch.outer(direction, direction)
        a, b = vectors[:, :3], vectors[:, 3:6]
        zero = torch.zeros_like(a)
        off = torch.stack((a.norm(dim=-1) - 1, b.norm(dim=-1) - 1, (a * b).sum(-1)), -1)
        rates = torch.stack(
            (
                torch.cat((a / a.norm(dim=-1, keepdim=True), zero), -1),
                torch.cat((zero, b / b.norm(dim=-1, keepdim=True)), -1),
                torch.cat((b, a), -1),
            ),
            1,
        )
        total = total + _UNIT_PRICE / 2 * off.square().sum()
        slope[:, SIX] += _UNIT_PRICE * (rates.mT @ off[..., None])[..., 0]
        square[:, SIX, SIX] += _UNIT_PRICE * rates.mT @ rates
        if normal is not None:
            normal.add(self.grid, square / count, slope / count)
        return float(total) / count


def descend(problem: Problem, state: State, steps: int) -> tuple[State, float]:
    """Levenberg-Marquardt steps until a step wins less than the share `_ENOUGH` of the price."""
    damping = 1e-3
    price, normal = problem.linearised(state)
    for _ in range(steps):
        try:
            by_control, by_shared = normal.factor(damping).step()
        except torch.linalg.LinAlgError:
            damping *= 10
            continue
        tried = State(state.control + by_control, state.shared + by_shared)
        cost = problem.price(tried)
        if not cost < price:
            damping *= 6
            if damping > 1e6:
                break
            continue
        won = price - cost
        state, damping = tried, max(damping / 4, 1e-9)
        price, normal = problem.linearised(state)
        if won < _ENOUGH * abs(price):
            break
    return state, price
