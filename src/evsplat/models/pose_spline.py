"""Learned course of a turn per joint and of a shift of the root: a cubic B-spline in time."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from evsplat.devices import send

# Columns: the four pieces of a uniform cubic B-spline; rows: powers 0 to 3 of the place in between.
_PIECES = torch.tensor(
    [[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=torch.float64
) / 6  # fmt: skip


class PoseSpline(nn.Module):
    """Values ``w(t) . c`` with uniform knots; no units.

    Control points c, ``rotations`` (K, J, 3) and ``translations`` (K, 3), start at zero. Variants:

    - ``centred_us``: the mean over these times is zero. A constant and a canonical shape that is
      bent the other way look the same, and the shape follows all frames.
    - ``held_us``: zero at each of these times. Taken off is the cubic spline through its own values
      there; what is left is how it moves from one to the next.
    """

    rotations: Tensor
    translations: Tensor
    mean: Tensor
    held: Tensor
    held_s: Tensor

    def __init__(
        self,
        span_us: tuple[int, int],
        knot_us: float,
        joints: int,
        *,
        centred_us: Sequence[int] = (),
        held_us: Sequence[int] = (),
        learned: bool = True,
    ) -> None:
        """Knots every ``knot_us`` from the start of ``span_us``; outside of it the ends are held.

        ``knot_us`` infinite: one value for all times. ``learned`` false: part of the state, but no
        parameter.
        """
        super().__init__()
        self.span_us, self.knot_us = span_us, float(knot_us)
        self.segments = max(1, math.ceil((span_us[1] - span_us[0]) / self.knot_us - 1e-9))
        self.count = 1 if math.isinf(knot_us) else self.segments + 3
        """Number of control points."""
        buffers = {
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
        elif len(centred_us):
            self.mean = self.weights(centred_us).mean(0)
        starts = {
            "rotations": torch.zeros(self.count, joints, 3),
            "translations": torch.zeros(self.count, 3),
        }
        for name, value in starts.items():
            if learned:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def weights(self, times_us: Sequence[int] | Tensor) -> Float[Tensor, "T K"]:
        """Weights of the control points at given times."""
        device = self.mean.device
        times = send(torch.as_tensor(times_us, dtype=torch.float64), device)
        if math.isinf(self.knot_us):
            return torch.ones(len(times), 1, device=device)
        place = (times.clamp(*self.span_us) - self.span_us[0]) / self.knot_us
        segment = place.floor().clamp(max=self.segments - 1)
        step = place - segment
        powers = torch.stack([torch.ones_like(step), step, step**2, step**3], 1)
        index = segment.long()[:, None] + torch.arange(4, device=device)
        found = torch.zeros(len(times), self.count, dtype=torch.float64, device=device)
        found.scatter_(1, index, powers @ send(_PIECES, device))
        if len(self.held):
            found = found - self._through_keys(times)
        return found.float() - self.mean

    def _through_keys(self, times: Float[Tensor, "T"]) -> Float[Tensor, "T K"]:
        """The cubic spline through what the control points weigh at the keys."""
        seconds = 1e-6 * (times.clamp(*self.span_us) - self.span_us[0])
        piece = torch.searchsorted(self.held_s, seconds, right=True) - 1
        piece = piece.clamp(0, len(self.held) - 1)
        step = (seconds - self.held_s[piece])[:, None]
        c3, c2, c1, c0 = self.held[piece].unbind(1)
        return ((c3 * step + c2) * step + c1) * step + c0

    def values(
        self, times_us: Sequence[int] | Tensor
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Values of the joints and of the root's place."""
        weights = self.weights(times_us)
        return torch.einsum("tk,kjc->tjc", weights, self.rotations), weights @ self.translations
