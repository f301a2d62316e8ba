"""Events around held-out frames, where the policy shows them."""

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from evsplat.capture import Frame
from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event_windows import EventWindows

RENDERS = 3
"""Rendered times around a held-out frame."""


class HeldOutWindows(Objective):
    """Events around a held-out frame, counted from the nearest training exposure on.

    Windows between neighbouring times say how the person moves; sums of them from a training
    exposure on, where the picture tells the pose, say where the person is. Events without polarity
    have no such sums. Only for a policy under which the events of held-out intervals are seen.
    """

    def __init__(self, windows: EventWindows, train_frames: Sequence[Frame]) -> None:
        """``windows`` knows events and sensor."""
        self.windows = windows
        self.train_frames = sorted(train_frames, key=lambda frame: frame.mid_us)

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """Random times: one in a training exposure, `RENDERS` around the frame."""
        draw = torch.rand(RENDERS + 2, generator=self.windows.generator).tolist()
        anchors = self._anchors(frame)
        start, end = anchors[int(draw[0] * len(anchors))].exposure_us
        anchor = start + int(draw[1] * (end - start))
        width = self.windows.interval_us / RENDERS
        first = frame.mid_us - self.windows.interval_us // 2
        around = (first + int((place + share) * width) for place, share in enumerate(draw[2:]))
        low, high = self.windows.range_us
        return sorted({anchor, *(min(max(time, low), high) for time in around)})

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: mean over windows, and over sums of them from the training exposure on."""
        times = step.times_us
        if len(times) < 2:
            return {}
        # without the training exposure the sums would begin nowhere
        if self.windows.readable(step) != slice(0, len(times)):
            return {}
        wrong = self.windows.differences(step, slice(None))
        lasting = [end - start for start, end in zip(times, times[1:], strict=False)]
        each = self.windows.mean(wrong, lasting)
        if not self.windows.events.has_polarity:
            return {"event": each}
        middle = step.frame.mid_us
        if abs(times[-1] - middle) > abs(times[0] - middle):
            wrong, lasting = wrong.flip(0), lasting[::-1]
        sums = self.windows.mean(wrong.cumsum(0), list(accumulate(lasting)))
        return {"event": 0.5 * (each + sums)}

    def _anchors(self, frame: Frame) -> list[Frame]:
        """The nearest training frames, on either side."""
        before = [other for other in self.train_frames if other.mid_us < frame.mid_us]
        after = [other for other in self.train_frames if other.mid_us > frame.mid_us]
        return [*before[-1:], *after[:1]]
