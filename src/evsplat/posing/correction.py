"""The correction of a motion: a Gaussian process in time, on cubic B-splines."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from evsplat.body import BodyTrack, PoseErrors, axis_angle_to_matrix
from evsplat.body.rotations import nearest_axis_angle

_KINDS = ((0.3, math.inf), (0.5, 0.2), (0.2, 0.03))
"""Shares of the variance of errors that last throughout, and for about so long (s)."""
_SHORTEST_US, _LONGEST_US = 20_000.0, 40_000.0
"""Bounds of the time between knots."""
_KEPT = 16
"""Sets of times whose given poses are kept."""
_LEAST_SHARE = 1e-4
"""Coordinates of less of the variance are left out."""


class Correction(nn.Module):
    """Turns of each joint and shifts of the root that are added to a motion, at any time.

    Their prior is a Gaussian process: each axis errs by a part that lasts for the whole sequence, a
    slow and a quick one (`_KINDS`). The parameters are M independent coordinates of unit variance
    per axis, so that what pictures at some times say of the lasting and slow parts holds at all.
    Turns are local: ``R_corrected = R_given exp(turn)``.
    """

    joint_rad: Tensor
    root_m: Tensor
    mixing: Tensor

    def __init__(
        self, track: BodyTrack, joint_rad: Float[np.ndarray, "J"], root_m: Float[np.ndarray, "3"]
    ) -> None:
        """``joint_rad``, ``root_m``: errors expected per axis; joints of 0 are left alone."""
        super().__init__()
        times = track.times_us
        gap = float(np.median(np.diff(times))) if len(times) > 1 else _LONGEST_US
        self.track = track
        self._start, self._end = int(times[0]), int(times[-1])
        self._knot_us = min(max(gap, _SHORTEST_US), _LONGEST_US)
        self._pieces = max(1, math.ceil((self._end - self._start) / self._knot_us - 1e-9))
        self.joints = torch.from_numpy(np.flatnonzero(joint_rad > 0))
        self.register_buffer("joint_rad", torch.as_tensor(joint_rad).float()[self.joints])
        self.register_buffer("root_m", torch.as_tensor(root_m).float())
        self.register_buffer("mixing", self._independent())
        self._known: dict[tuple[int, ...], tuple[Tensor, Tensor, Tensor]] = {}
        coordinates = self.mixing.shape[1]
        self.turns = nn.Parameter(torch.zeros(coordinates, len(self.joints), 3))
        self.shifts = nn.Parameter(torch.zeros(coordinates, 3))

    def weights(self, times_us: Sequence[int]) -> Float[Tensor, "T M"]:
        """Weights of the coordinates at given times; outside of the track its ends are held."""
        return torch.from_numpy(self._of_knots(times_us)).float() @ self.mixing

    def at(self, times_us: Sequence[int]) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T 3"]]:
        """The corrected motion: rotations local to the parent and the root's place."""
        rotations, transl, weights = self._given_at(tuple(times_us))
        turns = torch.einsum("tm,mjc->tjc", weights, self.turns) * self.joint_rad[:, None]
        turned = rotations[:, self.joints] @ axis_angle_to_matrix(turns)
        rotations = rotations.index_copy(1, self.joints, turned)
        return rotations, transl + self.root_m * (weights @ self.shifts)

    def _given_at(self, times_us: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """Given rotations and places, and `weights`: a descent asks for few times, in turns."""
        if times_us not in self._known:
            if len(self._known) == _KEPT:
                self._known.clear()
            self._known[times_us] = *self.track.at(times_us), self.weights(times_us)
        return self._known[times_us]

    def price(self) -> Float[Tensor, ""]:
        """Minus the logarithm of the prior, up to a constant."""
        return 0.5 * (self.turns.square().sum() + self.shifts.square().sum())

    @torch.no_grad()
    def corrected(self, errors: PoseErrors | None = None) -> BodyTrack:
        """The corrected motion with keys at `key_times`."""
        times = self.key_times
        rotations, transl = self.at(times.tolist())
        vectors = Rotation.from_matrix(rotations.flatten(0, 1).double().numpy()).as_rotvec()
        poses = nearest_axis_angle(vectors.reshape(len(times), -1, 3))
        places = transl.double().numpy()
        return self.track.with_keys(times, poses, places, source="corrected motion", errors=errors)

    @property
    def key_times(self) -> Int64[np.ndarray, "P"]:
        """Times of the track's keys, with more between them where they are farther apart."""
        own = self.track.times_us
        parts = [
            np.linspace(a, b, max(1, round((b - a) / self._knot_us)), endpoint=False)
            for a, b in zip(own, own[1:], strict=False)
        ]
        return np.unique(np.round(np.concatenate([*parts, own[-1:]])).astype(np.int64))

    def _of_knots(self, times_us: Sequence[int] | np.ndarray) -> Float[np.ndarray, "T K"]:
        """Weights of the control points of a uniform cubic B-spline."""
        times = np.clip(np.asarray(times_us, np.float64), self._start, self._end)
        place = np.minimum((times - self._start) / self._knot_us, self._pieces - 1e-9)
        knots = np.arange(-3.0, self._pieces + 4)
        return BSpline.design_matrix(place, knots, 3).toarray()

    def _independent(self) -> Float[Tensor, "K M"]:
        """Control points from independent coordinates, most important ones first."""
        seconds = 1e-6 * self._knot_us * np.arange(self._pieces + 3)
        apart = seconds[:, None] - seconds
        kernel = sum(share * np.exp(-0.5 * np.square(apart / lasts)) for share, lasts in _KINDS)
        values, vectors = np.linalg.eigh(kernel)
        kept = values > _LEAST_SHARE * values[-1]
        mixing = (vectors[:, kept] * np.sqrt(values[kept]))[:, ::-1]
        # A spline's values vary less than its control points.
        dense = self._of_knots(np.linspace(self._start, self._end, 4 * len(seconds)))
        size = np.sqrt(np.square(dense @ mixing).sum(1).mean())
        return torch.from_numpy(mixing / size).float()
