"""Learned errors of given poses: what holds throughout, what drifts, what is new in every key."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from evsplat.body import BodyTrack
from evsplat.body.spline_error import SplineError, apart_from_errors
from evsplat.devices import send
from evsplat.models.kept import Kept
from evsplat.models.pose_spline import PoseSpline
from evsplat.models.ridge import Ridge

SHARES = {"constant": 0.3, "slow": 0.5, "fast": 0.2}
"""Parts of an error's variance. Whoever fits poses to pictures errs by a habit per joint, by what
wanders with pose and view, and a little anew in every picture."""
SLOW_US = 200_000
"""Least time between knots of the slow part: no less than two key poses, either."""
_PRICED = 1_024
"""Keys whose price is asked at a time: an hour's would take as long as the rest of the step."""

_AT_ONCE = 1_024
"""Keys at which two motions are compared at a time."""
_SMALLEST = 1e-3
"""Weight of control points' squares, against those of keys that are missed."""


class PoseCorrection(nn.Module):
    """Residual of a track's poses: axis-angle vectors of the joints, shifts of the root.

    Three splines add up to the errors at the keys, each in units of its share of the errors that
    are expected there: ``constant``, which corrects held-out times as well as any; ``slow``, whose
    knots reach over a few frames, so that what is learned at training times is carried into gaps;
    ``fast``, with a knot per key. The latter two have mean zero over the training frames. A fourth,
    ``between``, is zero at every key: how the person moves from one to the next, which the track's
    own spline cannot know. Beside errors it is in units of what can be told from them
    (`apart_from_errors`).

    ``exact`` says which count: of poses that are exact only ``between``, else all four. It is part
    of the state, as are the errors expected and what was smoothed (`smooth_to`): they may have been
    found from pictures.
    """

    exact: Tensor
    started: Tensor
    """True where the errors began at what was found before training: they count from the start."""
    joint_rad: Tensor
    root_m: Tensor
    missed_rad: Tensor
    missed_m: Tensor

    def __init__(
        self,
        track: BodyTrack,
        frame_times_us: Sequence[int],
        *,
        joint_rad: Float[np.ndarray, "P J"],
        root_m: Float[np.ndarray, "P 3"],
        between: SplineError | None,
        exact: bool,
    ) -> None:
        """``joint_rad`` and ``root_m``: errors expected at the keys, per axis, radians and metres.

        ``between``: error expected of the track's spline between its keys; None: not learned, nor
        where there is one key.
        """
        super().__init__()
        times = track.times_us
        span, joints = (int(times[0]), int(times[-1])), track.poses.shape[1]
        gap = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        knots = {"constant": float("inf"), "slow": max(SLOW_US, 2 * gap), "fast": gap}
        self.errors = nn.ModuleDict(
            {
                name: PoseSpline(
                    span, knot_us, joints, centred_us=() if name == "constant" else frame_times_us
                )
                for name, knot_us in knots.items()
            }
        )
        self.smoothing = PoseSpline(span, gap, joints, learned=False)
        self.between = None
        if between is not None and len(times) > 1:
            missed = torch.from_numpy(between.rotation_rad), torch.tensor(between.translation_m)
            for name, value in zip(("missed_rad", "missed_m"), missed, strict=True):
                self.register_buffer(name, value, persistent=False)
            self.between = PoseSpline(span, gap / 2, joints, held_us=times.tolist())
        self.key_us = torch.from_numpy(times).double()  # on the host, where splines are weighed
        self.register_buffer("joint_rad", torch.as_tensor(joint_rad).float())
        self.register_buffer("root_m", torch.as_tensor(root_m).float())
        self.register_buffer("exact", torch.tensor(exact))
        self.register_buffer("started", torch.tensor(False))
        self._erring_axes, self._between_axes, self._unit = Kept(), Kept(), Kept()

    def _apply(self, fn: Any, recurse: bool = True) -> "PoseCorrection":
        exact, started = self.exact, self.started
        super()._apply(fn, recurse)
        self.exact, self.started = exact, started  # read on the host in every step
        return self

    def residual(
        self, times_us: Sequence[int] | Tensor
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Axis-angle vectors, radians, and shifts of the root, metres."""
        times = torch.as_tensor(times_us, dtype=torch.float64, device="cpu")
        turns = self.joint_rad.new_zeros(len(times), self.joint_rad.shape[1], 3)
        shifts = self.root_m.new_zeros(len(times), 3)
        if not bool(self.exact):
            turns, shifts = self._erring(times, turns, shifts)
        if self.between is not None:
            moved, placed = self.between.values(times)
            rad, metres = self._unit_between()
            turns = turns + moved * rad[:, None]
            shifts = shifts + placed * metres
        return turns, shifts

    def _unit_between(self) -> tuple[Float[Tensor, "J"], Float[Tensor, ""]]:
        """Of what is learned between keys, radians and metres: follows from the state."""
        if bool(self.exact):
            return self.missed_rad, self.missed_m

        def told() -> tuple[Tensor, Tensor]:
            share = SHARES["fast"]
            new_rad = (share * self.joint_rad.square().mean(0)).sqrt()
            new_m = (share * self.root_m.square().mean()).sqrt()
            rad = apart_from_errors(self.missed_rad, new_rad)
            return rad, apart_from_errors(self.missed_m, new_m)

        return self._unit.of([self.joint_rad, self.root_m], told)

    def _erring(self, times: Tensor, turns: Tensor, shifts: Tensor) -> tuple[Tensor, Tensor]:
        """Errors at the keys, added up from zeros, and what was smoothed."""
        for name, spline in self._errors():
            some_turns, some_shifts = spline.values(times)
            turns = turns + SHARES[name] ** 0.5 * some_turns
            shifts = shifts + SHARES[name] ** 0.5 * some_shifts
        joint_rad, root_m = self._expected(times)
        smoothed, moved = self.smoothing.values(times)
        return turns * joint_rad[..., None] + smoothed, shifts * root_m + moved

    def price(self, generator: torch.Generator | None = None) -> Float[Tensor, ""]:
        """Squares in units of what is expected, averaged over moving joints, root, axes and keys.

        A part with fewer knots than keys costs the less: each knot is one unknown. Of more than
        `_PRICED` keys a stretch drawn from ``generator`` stands for all.
        """
        keys = self.key_us
        if generator is not None and len(keys) > _PRICED:
            stretches = keys.tensor_split(-(-len(keys) // _PRICED))
            keys = stretches[int(torch.randint(len(stretches), (), generator=generator))]
        price = self.joint_rad.new_zeros(())
        if not bool(self.exact):
            parts = dict(self._errors())
            axes = self._erring_axes.of([self.joint_rad], lambda: _axes(self.joint_rad))
            for spline in parts.values():
                share = spline.count / parts["fast"].count
                price = price + share * self._price(spline, keys, axes)
        if self.between is not None:
            middles = ((keys[1:] + keys[:-1]) / 2).floor()
            if not self.between.still_zero(middles):
                unit = self._unit_between()[0][None]
                axes = self._between_axes.of([unit], lambda: _axes(unit))
                price = price + self._price(self.between, middles, axes)
        return price

    def _price(
        self, spline: PoseSpline, times_us: Tensor, moving_axes: tuple[Tensor, Tensor]
    ) -> Tensor:
        turns, shifts = spline.values(times_us)
        moving, axes = moving_axes
        every = torch.cat([(turns * moving).flatten(1), shifts], 1).flatten()
        return torch.dot(every, every) / (len(shifts) * axes)

    def _expected(self, times_us: Tensor) -> tuple[Tensor, Tensor]:
        """Errors expected at times, linear between the keys."""
        if len(self.key_us) == 1:
            return self.joint_rad, self.root_m
        upper = torch.searchsorted(self.key_us, times_us).clamp(1, len(self.key_us) - 1)
        early, late = self.key_us[upper - 1], self.key_us[upper]
        part = ((times_us - early) / (late - early)).clamp(0, 1).float()[:, None]
        device = self.joint_rad.device
        upper, part = send(upper, device), send(part, device)
        return tuple(  # type: ignore[return-value]
            torch.lerp(sizes[upper - 1], sizes[upper], part)
            for sizes in (self.joint_rad, self.root_m)
        )

    def _errors(self) -> Iterator[tuple[str, PoseSpline]]:
        for name, spline in self.errors.items():
            assert isinstance(spline, PoseSpline)
            yield name, spline

    def smooth_to(self, given: BodyTrack, smoothed: BodyTrack) -> None:
        """Add what turns the given keys into smoothed ones: not learned, and no error's price."""
        turns, shifts = _apart(given, smoothed)
        goal = torch.cat((turns.flatten(1), shifts), 1).double().numpy()
        # Two more control points than keys: of all that fit, the smallest. What is missed for being
        # the smallest is then made up for.
        ridge = Ridge([(self.smoothing, 1.0)], given.times_us.tolist(), _SMALLEST)
        found = ridge.solve(goal)
        goal -= ridge.values(found)
        found += ridge.solve(goal)
        _set(self.smoothing, found)

    def start_at(self, given: BodyTrack, better: BodyTrack, *, misfit: float = 0.05) -> None:
        """Set the errors to the likeliest that turn the given motion into a better one.

        Ridge regression at the given keys: each unknown has variance one, and the better motion
        errs by ``misfit`` in units of what is expected. From then on the errors count.
        """
        self.fit(given.times_us.tolist(), *_apart(given, better), misfit=misfit)

    def fit(
        self,
        times_us: Sequence[int],
        turns: Float[Tensor, "T J 3"],
        shifts: Float[Tensor, "T 3"],
        *,
        misfit: float,
    ) -> None:
        """Set the errors to the likeliest that give these residuals; see `start_at`."""
        times = torch.as_tensor(times_us, dtype=torch.float64)
        joint_rad, root_m = self._expected(times)
        goal_turns = torch.where(joint_rad[..., None] > 0, turns / joint_rad[..., None], 0.0)
        goal = torch.cat((goal_turns.flatten(1), shifts / root_m.clamp_min(1e-6)), 1)
        parts = [(spline, SHARES[name] ** 0.5) for name, spline in self._errors()]
        found = Ridge(parts, times_us, misfit).solve(goal.double().numpy())
        ends = np.cumsum([spline.count for spline, _ in parts])[:-1]
        for (spline, _), values in zip(parts, np.split(found, ends), strict=True):
            _set(spline, values)
        self.started.fill_(True)

    def forget(self) -> None:
        """Set all residuals to zero."""
        with torch.no_grad():
            for value in (*self.parameters(), *self.smoothing.whole()):
                value.zero_()


def _axes(expected: Float[Tensor, "P J"]) -> tuple[Tensor, Tensor]:
    """Joints that are expected to move, (J, 1), and how many axes they and the root have."""
    moving = (expected > 0).any(0)
    return moving[:, None], 3 * (moving.sum() + 1)


@torch.no_grad()
def _set(spline: PoseSpline, values: Float[np.ndarray, "K C"]) -> None:
    """Control points: turns of the joints and, in the last three columns, shifts."""
    found = torch.from_numpy(values.astype(np.float32))
    rotations, translations = spline.whole()
    rotations.copy_(found[:, :-3].view_as(rotations))
    translations.copy_(found[:, -3:])


def _apart(
    first: BodyTrack, second: BodyTrack
) -> tuple[Float[Tensor, "P J 3"], Float[Tensor, "P 3"]]:
    """Turns and shifts from one motion to another at the keys of the first."""
    turned, moved = [], []
    for times in torch.from_numpy(first.times_us).split(_AT_ONCE):
        (turns, places), (other_turns, other_places) = first.at(times), second.at(times)
        apart = (turns.mT @ other_turns).double().cpu().numpy()
        vectors = Rotation.from_matrix(apart.reshape(-1, 3, 3)).as_rotvec()
        turned.append(torch.from_numpy(vectors).to(other_places).view(*apart.shape[:2], 3))
        moved.append(other_places - places)
    return torch.cat(turned), torch.cat(moved)
