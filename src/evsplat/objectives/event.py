"""The event term: rendered brightness change against the events between two times (eq. 8-9)."""

from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.capture import Frame, TrainingCapture
from evsplat.compiled import native, runs_native
from evsplat.devices import DeviceCache
from evsplat.events import count_map, polarity_counts
from evsplat.objectives.base import Objective, Step
from evsplat.pictures import log_brightness_change

CACHED_MAPS = 256
"""Event maps kept in memory; at 1280x720 about 0.9 GB, at 256x256 64 MB."""


def normalised(values: Float[Tensor, "H W"], floor: float) -> Float[Tensor, "H W"]:
    """A map divided by its Frobenius norm, which is kept from vanishing by ``floor`` (A16).

    The divisor is ``sqrt(|x|^2 + N floor^2)``: a map of pure noise far below the floor stays small
    instead of being blown up to unit norm.
    """
    return values / torch.sqrt(values.square().sum() + values.numel() * floor**2)


def event_loss(
    change: Float[Tensor, "H W"], events: Float[Tensor, "H W"], *, floor: float = 0.03
) -> Float[Tensor, ""]:
    """Distance of two maps of unit norm, in 0..2 at any resolution (eq. 9, A15-A16).

    ``change`` is the rendered log-brightness change, ``events`` the signed event count; the
    contrast threshold cancels. Sum of absolute differences divided by ``sqrt(N)``.
    """
    if runs_native(change) and runs_native(events) and not events.requires_grad:
        distance: Tensor = _NativeEventLoss.apply(change, events, floor)
        return distance
    difference = normalised(change, floor) - normalised(events, floor)
    return difference.abs().sum() / difference.numel() ** 0.5


class _NativeEventLoss(torch.autograd.Function):
    """`event_loss` in the compiled module."""

    @staticmethod
    def forward(ctx: Any, change: Tensor, events: Tensor, floor: float) -> Tensor:
        maps = change.detach().contiguous(), events.contiguous()
        ctx.known = native.map_difference(*maps, floor, torch.get_num_threads())
        ctx.save_for_backward(*maps)
        return change.new_tensor(ctx.known[2] / change.numel() ** 0.5)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        change, events = ctx.saved_tensors
        gradient = torch.empty_like(change)
        weight = float(upstream[0]) / change.numel() ** 0.5
        threads = torch.get_num_threads()
        native.map_difference_backward(change, events, ctx.known, weight, gradient, threads)
        return gradient, None, None


class EventChange(Objective):
    """Event loss between consecutive training frames, at their mid-exposures (A13).

    Where events have no polarity, the size of the change is compared with their number.
    """

    def __init__(
        self,
        capture: TrainingCapture,
        *,
        start: float,
        floor: float = 0.03,
        eps: float = 1e-5,
        weight_by_activity: bool = True,
        min_active: float = 0.001,
    ) -> None:
        """``start`` in nominal iterations; ``min_active`` is the least share of active pixels."""
        assert capture.events is not None
        self.capture, self.events = capture, capture.events
        self.start, self.floor, self.eps = start, floor, eps
        self.weight_by_activity, self.min_active = weight_by_activity, min_active
        self._map = lru_cache(CACHED_MAPS)(self._count)
        self.partner: dict[str, Frame] = {}
        frames = capture.frames
        train = capture.train_frames
        follows = zip(train, train[1:], strict=False)
        pairs = [(a, b) for a, b in follows if b.index == a.index + 1]
        for first, second in pairs:
            if frames[first.index].camera != frames[second.index].camera:
                continue
            self.partner.setdefault(first.name, second)
        for first, second in pairs:
            # The last frame of a run has no successor: it looks back instead.
            self.partner.setdefault(second.name, first)

    @cached_property
    def weights(self) -> dict[tuple[int, int], float]:
        """Weight of each pair of mid-exposures by its share of active pixels (A16, A17)."""
        partnered = [f for f in self.capture.train_frames if f.name in self.partner]
        activity = {
            pair: float((self._map(*pair) != 0).float().mean())
            for pair in {self._pair(frame) for frame in partnered}
        }
        positive = [share for share in activity.values() if share > 0]
        median = float(torch.tensor(positive).median()) if positive else 1.0
        return {
            pair: (min(max(share / median, 0.25), 4.0) if self.weight_by_activity else 1.0)
            * (share >= self.min_active)
            for pair, share in activity.items()
        }

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """Mid-exposures of the drawn frame and its neighbour, once events are used."""
        if nominal < self.start or frame.name not in self.partner:
            return ()
        return self._pair(frame)

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The event map of the frame and its neighbour."""
        if self.times(frame, nominal):
            before, after = self._pair(frame)
            data.prefetch(("events", before, after), partial(self._map, before, after))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: the normalised difference, weighted by how active the pair is (A17)."""
        if not self.times(step.frame, step.nominal):
            return {}
        before, after = self._pair(step.frame)
        weight = self.weights[(before, after)]
        if weight == 0.0:
            return {}
        change = log_brightness_change(
            step.rgb[step.index(before)],
            step.rgb[step.index(after)],
            eps=self.eps,
            transfer=step.capture.transfer(step.frame),
        )
        events = step.data.get(("events", before, after), partial(self._map, before, after))
        if not self.events.has_polarity:
            change = change.abs()
        return {"event": weight * event_loss(change, events, floor=self.floor)}

    def _pair(self, frame: Frame) -> tuple[int, int]:
        times = sorted((frame.mid_us, self.partner[frame.name].mid_us))
        return times[0], times[1]

    def _count(self, start_us: int, end_us: int) -> Float[Tensor, "H W"]:
        """Signed event count between two times; unsigned without polarity."""
        window = self.events.between(start_us, end_us)
        size = self.events.height, self.events.width
        signed = self.events.has_polarity
        return count_map(window, *size) if signed else polarity_counts(window, *size).sum(0)
