"""Learned errors of a motion: a cubic B-spline in time per joint and for the root."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from evsplat.body import BodyTrack
from evsplat.body.smoothing import MotionNoise, SplineError
from evsplat.devices import send

# Columns: the four pieces of a uniform cubic B-spline; rows: powers 0 to 3 of the place in between.
_PIECES = torch.tensor(
    [[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=torch.float64
) / 6  # fmt: skip


STIFFEST = 10.0
"""Bound of the stiffness, in cubed times between key poses. More would only slow the descent: a
residual that changes sign in every key pose pays 160 times its square."""


class PoseSpline(nn.Module):
    """The residual's course between times: ``w(t) . c`` with uniform knots over the key poses.

    Control points c, ``rotations`` (K, J, 3) and ``translations`` (K, 3), are in units of what is
    expected: `joint_rad` for axis-angle vectors, `root_m` for the root's place, so that one
    learning rate and one prior fit all. They start at zero.

    Where key poses are exact, the residual is zero at each (``held_us``): taken from it is the
    cubic spline through its own values there. What is left is how the person moves from key to key,
    which the track's spline cannot know.

    Otherwise the mean over the training frames is taken out. A constant residual and a canonical
    shape that is bent the other way look the same, and the shape follows all frames: left free,
    knots of frames that no picture corrects would stay behind.
    """

    joint_rad: Tensor
    joint_stiffness: Tensor
    root_stiffness: Tensor
    mean: Tensor
    held: Tensor
    held_s: Tensor

    def __init__(
        self,
        span_us: tuple[int, int],
        knot_us: float,
        frame_times_us: Sequence[int],
        *,
        joint_rad: Float[Tensor, " J"],
        root_m: float,
        stiffness_s3: Float[Tensor, " J+1"] | None = None,
        held_us: Sequence[int] = (),
    ) -> None:
        """Knots every ``knot_us`` from the start of ``span_us``; outside of it the ends are held.

        ``stiffness_s3`` weighs the squared second derivative in time against the square, in s^3 as
        `MotionNoise` has it; 0 without.
        """
        super().__init__()
        self.span_us, self.knot_us, self.root_m = span_us, float(knot_us), root_m
        self.segments = max(1, math.ceil((span_us[1] - span_us[0]) / self.knot_us - 1e-9))
        if stiffness_s3 is None:
            stiffness_s3 = torch.zeros(len(joint_rad) + 1)
        buffers = {
            "joint_rad": joint_rad.float(),
            "joint_stiffness": stiffness_s3[:-1].float(),
            "root_stiffness": stiffness_s3[-1].float(),
            "mean": torch.zeros(self.count),
            "held": torch.zeros(0, 4, self.count, dtype=torch.float64),
            "held_s": torch.zeros(0, dtype=torch.float64),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        if len(held_us) > 1:
            self.held_s = 1e-6 * (torch.tensor(held_us, dtype=torch.float64) - span_us[0])
            through = CubicSpline(self.held_s.numpy(), self.weights(held_us).double().numpy())
            self.held = torch.from_numpy(through.c.transpose(1, 0, 2).copy())
        else:
            self.mean = self.weights(frame_times_us).mean(0)
        self.rotations = nn.Parameter(torch.zeros(self.count, len(joint_rad), 3))
        self.translations = nn.Parameter(torch.zeros(self.count, 3))

    @classmethod
    def of(
        cls,
        track: BodyTrack,
        noise: MotionNoise,
        frame_times_us: Sequence[int],
        *,
        knot_frames: float,
        joint_rad: float,
        root_m: float,
        stiff: bool,
    ) -> Self:
        """For a track: joints that never move are left alone, knots follow the key poses.

        ``stiff``: the key poses were smoothed as ``noise`` says. What was least in
        ``errors^2 + stiffness * bending^2`` stays least if the residual pays the same price.
        """
        times = torch.from_numpy(track.times_us)
        stiffness = torch.from_numpy(noise.stiffness_s3)
        gap = float(times.diff().double().median()) if len(times) > 1 else 1.0
        return cls(
            (int(times[0]), int(times[-1])),
            knot_frames * gap,
            frame_times_us,
            joint_rad=joint_rad * torch.from_numpy(noise.moving),
            root_m=root_m,
            stiffness_s3=stiffness.clamp(max=STIFFEST * (1e-6 * gap) ** 3) if stiff else None,
        )

    @classmethod
    def between_keys(cls, track: BodyTrack, expected: SplineError) -> Self:
        """For a track with exact key poses: zero at each, two knots from one to the next."""
        times = torch.from_numpy(track.times_us)
        return cls(
            (int(times[0]), int(times[-1])),
            float(times.diff().double().median()) / 2,
            (),
            joint_rad=torch.from_numpy(expected.rotation_rad),
            root_m=expected.translation_m,
            held_us=times.tolist(),
        )

    @property
    def count(self) -> int:
        """Number of control points."""
        return self.segments + 3

    def weights(
        self, times_us: Sequence[int] | Tensor, *, derivative: int = 0
    ) -> Float[Tensor, "T K"]:
        """Weights of the control points at given times, or their second derivative (1/s^2)."""
        device = self.mean.device
        times = send(torch.as_tensor(times_us, dtype=torch.float64), device)
        place = (times.clamp(*self.span_us) - self.span_us[0]) / self.knot_us
        segment = place.floor().clamp(max=self.segments - 1)
        step = place - segment
        if derivative == 0:
            powers = torch.stack([torch.ones_like(step), step, step**2, step**3], 1)
        else:
            zero = torch.zeros_like(step)
            powers = torch.stack([zero, zero, 2 + zero, 6 * step], 1) / (self.knot_us * 1e-6) ** 2
        index = segment.long()[:, None] + torch.arange(4, device=device)
        found = torch.zeros(len(times), self.count, dtype=torch.float64, device=device)
        found.scatter_(1, index, powers @ send(_PIECES, device))
        if len(self.held):
            found = found - self._through_keys(times, derivative)
        return found.float() if derivative else found.float() - self.mean

    def _through_keys(self, times: Float[Tensor, "T"], derivative: int) -> Float[Tensor, "T K"]:
        """The cubic spline through what the control points weigh at the keys."""
        seconds = 1e-6 * (times.clamp(*self.span_us) - self.span_us[0])
        piece = torch.searchsorted(self.held_s, seconds, right=True) - 1
        piece = piece.clamp(0, len(self.held) - 1)
        step = (seconds - self.held_s[piece])[:, None]
        c3, c2, c1, c0 = self.held[piece].unbind(1)
        if derivative:
            return 6 * c3 * step + 2 * c2
        return ((c3 * step + c2) * step + c1) * step + c0

    def residual(
        self, times_us: Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Axis-angle vectors, radians, and shifts of the root, metres."""
        weights = self.weights(times_us)
        turns = torch.einsum("tk,kjc->tjc", weights, self.rotations) * self.joint_rad[:, None]
        return turns, self.root_m * (weights @ self.translations)

    def forget(self) -> None:
        """Set all control points to zero."""
        with torch.no_grad():
            self.rotations.zero_()
            self.translations.zero_()
