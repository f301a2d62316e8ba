"""Events at full time resolution: brightness change between any two rendered times."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import send
from evsplat.events import EventStream, begun_counts, polarity_counts
from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event_sensor import EventNoise, EventSensor
from evsplat.pictures import luminance

_RATE_US = 1_000
"""Time before and after an instant in which events are counted for their rate there."""
RENDERS = 3
"""Rendered times around a held-out frame."""


class EventWindows(Objective):
    """Mean absolute difference between rendered change and events, amplitude kept (eq. 3).

    Windows lie between neighbouring rendered times and from the first to the last. Besides the
    times of other objectives one more is asked for, at random before or after the exposure, within
    ``reach`` intervals of the training frames, so that the gaps between exposures teach as well.
    All pixels count: where there is no event, nothing changed. Nothing is asked of times whose
    events may not be read (`EventStore.readable_around`): there the gap is on one side only, and
    what is looked at around a window ends with it.

    Events that nothing caused are allowed for: differences weigh by the noise of their time
    (`EventNoise`), and hot pixels do not count.

    Where events have no polarity the size of the change is compared with their number, between
    neighbouring times only: over a longer span what went up and down again is in the number alone.
    """

    def __init__(
        self,
        capture: TrainingCapture,
        sensor: EventSensor,
        generator: torch.Generator,
        *,
        start: float,
        eps: float,
        noise: EventNoise,
        reach: float = 0.5,
        ramp_us: int = 0,
    ) -> None:
        """``start`` in nominal iterations; ``eps`` is added to linear luminance.

        Between events of one polarity at most ``ramp_us`` apart brightness changes evenly
        (`begun_counts`); 0: all at once, when the second one tells.
        """
        assert capture.events is not None
        self.events, self.sensor, self.generator = capture.events, sensor, generator
        self.start, self.eps = start, eps
        mids = [frame.mid_us for frame in capture.frames]
        self.interval_us = _median_gap(mids)
        self.reach_us = reach * _median_gap([frame.mid_us for frame in capture.train_frames])
        self.range_us = (min(mids), max(mids))
        self.noise = noise
        self.ramp_us = ramp_us

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """One time outside of the exposure; none where there is no room on either side."""
        if nominal < self.start:
            return ()
        draw = torch.rand(2, generator=self.generator).tolist()
        start, end = frame.exposure_us
        low, high = self.events.readable_around(frame.mid_us)
        before = min(self.reach_us, start - max(low, self.range_us[0]))
        after = min(self.reach_us, min(high, self.range_us[1]) - end)
        if max(before, after) < 1:
            return ()
        if after < 1 or (draw[1] < 0.5 and before >= 1):
            return (start - 1 - int(draw[0] * (before - 1)),)
        return (end + int(draw[0] * after),)

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: mean over windows, pixels and the whole span; ``contrast``: `apart`."""
        kept = self.readable(step)
        times = step.times_us[kept]
        if step.nominal < self.start or len(times) < 2:
            return {}
        wrong = self.differences(step, kept)
        event = self.mean(
            wrong, [end - start for start, end in zip(times, times[1:], strict=False)]
        )
        if self.events.has_polarity:
            # The whole span as well: small errors of one sign in each window add up in it.
            event = 0.5 * (event + self.mean(wrong.sum(0, keepdim=True), [times[-1] - times[0]]))
        return {"event": event, "contrast": self.sensor.apart()}

    def readable(self, step: Step) -> slice:
        """The part of a step's times between which events may be read, by the events' clock."""
        low, high = self.events.readable_around(step.frame.mid_us)
        late = [time + self._late_us for time in step.times_us]
        return slice(bisect_left(late, low), bisect_right(late, high))

    @property
    def _late_us(self) -> int:
        """Lag of the events behind the frames' clock, as learned so far."""
        offset = self.sensor.offset_us
        return 0 if offset is None else round(float(offset.detach()))

    def differences(self, step: Step, kept: slice) -> Float[Tensor, "T-1 H W"]:
        """Rendered less reported change of log-brightness between the neighbouring times kept.

        Without polarity: of the change's size.
        """
        offset = self.sensor.offset_us
        late = [time + self._late_us for time in step.times_us[kept]]
        low, high = self.events.readable_around(step.frame.mid_us)
        # A sensor compares logarithms of light, before any transfer curve of a camera.
        brightness = torch.log(luminance(step.linear[kept]) + self.eps)
        reach = max(_RATE_US, self.ramp_us)
        stream = self.events.between(max(late[0] - reach, low), min(late[-1] + reach, high))
        windows = list(zip(late, late[1:], strict=False))
        counts = self._counts(stream, windows, brightness.device)
        changes = brightness[1:] - brightness[:-1]
        # Without polarity a window's events tell how far brightness went, not which way.
        if not self.events.has_polarity:
            return changes.abs() - self.sensor.path(counts.sum(1))
        if self.ramp_us > 0:
            size = self.events.height, self.events.width
            begun = begun_counts(stream, late, *size, reach_us=self.ramp_us)
            counts = counts + send(begun[1:] - begun[:-1], counts.device)
        reported = self.sensor.change(*counts.unbind(1))
        if offset is not None:
            # Events per microsecond at each instant tell what a later clock would have counted.
            around = [(max(time - _RATE_US, low), min(time + _RATE_US, high)) for time in late]
            rates = self.sensor.change(*self._counts(stream, around, brightness.device).unbind(1))
            lasting = torch.tensor([end - start for start, end in around], dtype=rates.dtype)
            rates = rates.detach() / send(lasting, rates.device)[:, None, None]
            reported = reported + (offset - offset.detach()) * (rates[1:] - rates[:-1])
        return changes - reported

    def mean(
        self, differences: Float[Tensor, "N H W"], durations_us: Sequence[int]
    ) -> Float[Tensor, ""]:
        """Mean size of differences that built up over so long, weighed by the sensor's noise."""
        sound = send(self.noise.sound, differences.device)
        each = torch.tensor([self.noise.weight(duration) for duration in durations_us])
        weights = send(each.to(sound.dtype), differences.device)
        return (sound * weights[:, None, None] * differences.abs()).mean()

    def _counts(
        self, stream: EventStream, windows: Sequence[tuple[int, int]], device: torch.device
    ) -> Float[Tensor, "W 2 H W"]:
        """Events per window, polarity (brighter first) and pixel."""
        size = self.events.height, self.events.width
        maps = [polarity_counts(stream.between(*ends), *size) for ends in windows]
        return send(torch.stack(maps), device)


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


def _median_gap(times_us: Sequence[int]) -> int:
    ordered = sorted(times_us)
    gaps = sorted(b - a for a, b in zip(ordered, ordered[1:], strict=False))
    return gaps[len(gaps) // 2] if gaps else 0
