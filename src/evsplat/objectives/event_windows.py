"""Events at full time resolution: brightness change between any two rendered times."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.capture import Frame, TrainingCapture
from evsplat.compiled import native, runs_native
from evsplat.devices import DeviceCache, constant, send
from evsplat.events import ALWAYS, EventStore, Span, polarity_counts, window_counts
from evsplat.events.on_device import EventBlocks
from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event_sensor import EventNoise, EventSensor

_RATE_US = 1_000
"""Time before and after an instant in which events are counted for their rate there."""
_PARTS = 10
"""Of a period of flicker, over which counts are averaged."""
_SILENT_FRAMES = 2
"""Intervals between frames."""


class EventWindows(Objective):
    """Mean absolute difference between rendered change and events, amplitude kept (eq. 3).

    Windows lie between neighbouring rendered times and from the first to the last. Besides the
    times of other objectives one more is asked for, at random before or after the exposure, within
    ``reach`` intervals of the training frames, so that the gaps between exposures teach as well.
    All pixels count: where there is no event, nothing changed. Nothing is asked of times whose
    events may not be read (`EventStore.readable_around`): there the gap is on one side only, and
    what is looked at around a window ends with it. The same holds for times before and after a
    recording that does not cover the frames, and of those in which the sensor lost its events: it
    says nothing of them, not that nothing changed.

    Events that nothing caused are allowed for: differences weigh by the noise of their time
    (`EventNoise`), and hot pixels do not count.

    Events see luminance. Where it is wrong its gradient pulls at green ten times as hard as at
    blue, and the frames pull back at all channels alike: what comes of it is a tint. From nominal
    iteration ``hue_from`` on all channels are pulled at alike (`CodedPictures.log_luminance`).

    Where lamps flicker, counts up to a time are the mean over a period about it: in that every
    pixel is as often brighter as darker.

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
        hue_from: float = math.inf,
        flicker_us: int = 0,
        untold_us: Sequence[Span] = (),
    ) -> None:
        """``start`` in nominal iterations; ``eps`` is added to linear luminance.

        Between events of one polarity at most ``ramp_us`` apart brightness changes evenly
        (`begun_counts`); 0: all at once, when the second one tells. ``flicker_us``: the period in
        which lamps flicker; 0: they do not. ``untold_us``: when, in order, events were lost.
        """
        assert capture.events is not None
        self.events = capture.events
        self.blocks = EventBlocks(self.events)
        self.sensor, self.generator = sensor, generator
        self.start, self.eps, self.hue_from = start, eps, hue_from
        mids = [frame.mid_us for frame in capture.frames]
        self.interval_us = _median_gap(mids)
        self.reach_us = reach * _median_gap([frame.mid_us for frame in capture.train_frames])
        self.range_us = (min(mids), max(mids))
        self.recorded_us = _recorded(self.events, capture.train_frames, self.interval_us)
        self.noise = noise
        self.ramp_us, self.flicker_us = ramp_us, flicker_us
        self.untold_us = tuple(untold_us)

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """One time outside of the exposure; none where there is no room on either side."""
        if nominal < self.start:
            return ()
        draw = torch.rand(2, generator=self.generator).tolist()
        start, end = frame.exposure_us
        low, high = self._told_around(frame)
        if end <= low or start >= high:
            return ()
        before = min(self.reach_us, start - max(low, self.range_us[0]))
        after = min(self.reach_us, min(high, self.range_us[1]) - end)
        if max(before, after) < 1:
            return ()
        if after < 1 or (draw[1] < 0.5 and before >= 1):
            return (start - 1 - int(draw[0] * (before - 1)),)
        return (end + int(draw[0] * after),)

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The events that any times around the frame could ask for."""
        if nominal < self.start or data.device.type == "cpu":
            return
        low, high = self._known_around(frame)
        reach = int(self.reach_us) + self._looks_around_us
        start, end = (time + self._late_us for time in frame.exposure_us)
        self.blocks.prefetch(data, max(start - reach, low), min(end + reach, high))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: mean over windows, pixels and the whole span; ``contrast``: `apart`."""
        kept = self.readable(step)
        times = step.times_us[kept]
        if step.nominal < self.start or len(times) < 2:
            return {}
        seen = self._seen(step, kept)
        lasting = [end - start for start, end in zip(times, times[1:], strict=False)]
        whole = times[-1] - times[0]
        if self.events.has_polarity:
            event = self._compared(seen, lasting, whole)
        else:
            event = self.mean(self._differences(seen), lasting)
        return {"event": event, "contrast": self.sensor.apart()}

    def readable(self, step: Step) -> slice:
        """The part of a step's times between which events are known, by the events' clock."""
        low, high = self._told_around(step.frame)
        late = [time + self._late_us for time in step.times_us]
        return slice(bisect_left(late, low), bisect_right(late, high))

    def _known_around(self, frame: Frame) -> Span:
        """The stretch of the events' clock about a frame in which events are readable and recorded.

        It is empty, its end before its start, for a frame that lies wholly beside the recording
        or in the middle of whose exposure events were lost.
        """
        middle = frame.mid_us
        low, high = self.events.readable_around(middle)
        low, high = max(low, self.recorded_us[0]), min(high, self.recorded_us[1])
        for start, end in self.untold_us:
            if start < middle < end:
                return middle, middle - 1
            low = max(low, end) if end <= middle else low
            high = min(high, start) if start >= middle else high
        return low, high

    def _told_around(self, frame: Frame) -> Span:
        """The part of it at whose times all events are known that count for them."""
        low, high = self._known_around(frame)
        return low + self.flicker_us // 2, high - self.flicker_us // 2

    @property
    def _looks_around_us(self) -> int:
        """Time before and after an instant whose events say something of it."""
        return max(self._rate_us, self.ramp_us + self.flicker_us // 2)

    @property
    def _rate_us(self) -> int:
        """Time before and after an instant in which events are counted for their rate there."""
        return max(_RATE_US, self.flicker_us // 2)

    @property
    def _late_us(self) -> int:
        """Lag of the events behind the frames' clock, as learned so far."""
        offset = self.sensor.offset_us
        return 0 if offset is None else round(float(offset.detach()))

    def differences(self, step: Step, kept: slice) -> Float[Tensor, "T-1 H W"]:
        """Rendered less reported change of log-brightness between the neighbouring times kept.

        Without polarity: of the change's size.
        """
        return self._differences(self._seen(step, kept))

    def _seen(self, step: Step, kept: slice) -> "_Seen":
        """What is compared at the times kept."""
        late = [time + self._late_us for time in step.times_us[kept]]
        low, high = self._known_around(step.frame)
        # A sensor compares logarithms of light, before any transfer curve of a camera.
        pulls_at_all = step.nominal >= self.hue_from
        brightness = step.pictures.log_luminance(self.eps, kept, keeps_hue=pulls_at_all)
        reach, rate_us = self._looks_around_us, self._rate_us
        within = max(late[0] - reach, low), min(late[-1] + reach, high)
        # Events per microsecond at each instant tell what a later clock would have counted.
        around = [(max(time - rate_us, low), min(time + rate_us, high)) for time in late]
        drifts = self.sensor.offset_us is not None and self.events.has_polarity
        counts, maps = self._counted(step.data, late, within, around if drifts else [])
        drift = None
        if maps is not None:
            lasting = torch.tensor([end - start for start, end in around], dtype=torch.float32)
            rates = (
                send(maps, brightness.device)
                / send(lasting, brightness.device)[:, None, None, None]
            )
            with torch.no_grad():
                rate = self.sensor.change(*rates.unbind(1))
                drift = rate[1:] - rate[:-1]
        sound = step.data.get("sound pixels", lambda: self.noise.sound)
        return _Seen(brightness, send(counts, brightness.device), drift, sound)

    def _counted(
        self, data: DeviceCache, late_us: Sequence[int], within_us: Span, around_us: Sequence[Span]
    ) -> tuple[Float[Tensor, "T-1 2 H W"], Float[Tensor, "T 2 H W"] | None]:
        """Events between times, and those in the spans around them if there are any."""
        ramp_us = self.ramp_us if self.events.has_polarity else 0
        if data.device.type != "cpu":
            events = self.blocks.between(data, *within_us)
            counts = self._averaged(
                lambda times: events.window_counts(times, within_us, reach_us=ramp_us), late_us
            )
            return counts, events.counts_around(around_us) if around_us else None
        size = self.events.height, self.events.width
        stream = self.events.between(*within_us)
        counts = self._averaged(
            lambda times: window_counts(stream, times, *size, reach_us=ramp_us), late_us
        )
        maps = [polarity_counts(stream.between(*span), *size) for span in around_us]
        return counts, torch.stack(maps) if maps else None

    def _averaged(
        self, count: Callable[[Sequence[int]], Tensor], times_us: Sequence[int]
    ) -> Tensor:
        """What is counted between times, on average over a period of flicker about each."""
        if not self.flicker_us:
            return count(times_us)
        shifts = [round(self.flicker_us * ((k + 0.5) / _PARTS - 0.5)) for k in range(_PARTS)]
        maps = (count([time + shift for time in times_us]) for shift in shifts)
        return reduce(torch.add, maps) / _PARTS

    def _differences(self, seen: "_Seen") -> Float[Tensor, "T-1 H W"]:
        changes = seen.brightness[1:] - seen.brightness[:-1]
        # Without polarity a window's events tell how far brightness went, not which way.
        if not self.events.has_polarity:
            return changes.abs() - self.sensor.path(seen.counts.sum(1))
        reported = self.sensor.change(*seen.counts.unbind(1))
        offset = self.sensor.offset_us
        if offset is not None and seen.drift is not None:
            reported = reported + (offset - offset.detach()) * seen.drift
        return changes - reported

    def _compared(self, seen: "_Seen", durations_us: Sequence[int], whole_us: int) -> Tensor:
        """Mean size of the differences and of their sum.

        The whole span as well: small errors of one sign in each window add up in it.
        """
        pixels = seen.brightness[0].numel()
        each = [self.noise.weight(duration) / len(durations_us) for duration in durations_us]
        offset = self.sensor.offset_us
        event: Tensor = _Compared.apply(
            seen.brightness,
            self.sensor.thresholds,
            offset,
            seen.counts,
            seen.drift,
            seen.sound,
            torch.tensor(each) * (0.5 / pixels),
            self.noise.weight(whole_us) * (0.5 / pixels),
        )
        return event

    def mean(
        self, differences: Float[Tensor, "N H W"], durations_us: Sequence[int]
    ) -> Float[Tensor, ""]:
        """Mean size of differences that built up over so long, weighed by the sensor's noise."""
        sound = send(self.noise.sound, differences.device)
        each = torch.tensor([self.noise.weight(duration) for duration in durations_us])
        weights = send(each.to(sound.dtype), differences.device)
        return (sound * weights[:, None, None] * differences.abs()).mean()


@dataclass(frozen=True, eq=False)
class _Seen:
    """Rendered and recorded brightness at T times."""

    brightness: Float[Tensor, "T H W"]
    """Natural logarithm."""
    counts: Float[Tensor, "T-1 2 H W"]
    """Events between the times, of either polarity."""
    drift: Float[Tensor, "T-1 H W"] | None
    """Slope of the reported change by the lag of the events' clock, per microsecond."""
    sound: Float[Tensor, "H W"]
    """0 at hot pixels, 1 elsewhere."""


class _Compared(torch.autograd.Function):
    """Weighted size of differences between windows, and of their sum; slopes are found at once."""

    @staticmethod
    def forward(
        ctx: Any,
        brightness: Float[Tensor, "T H W"],
        thresholds: Float[Tensor, "2"],
        offset: Float[Tensor, ""] | None,
        counts: Float[Tensor, "T-1 2 H W"],
        drift: Float[Tensor, "T-1 H W"] | None,
        sound: Tensor,
        weights: Float[Tensor, "T-1"],
        whole: float,
    ) -> Float[Tensor, ""]:
        if not runs_native(brightness):
            value, *slopes = _compared(brightness, thresholds, counts, drift, sound, weights, whole)
            ctx.save_for_backward(*slopes)
            return value
        slope = torch.empty_like(brightness)
        total, *by = native.window_difference(
            brightness.detach().contiguous(),
            counts,
            None if drift is None else drift.contiguous(),
            sound.float().contiguous(),
            weights.float(),
            whole,
            thresholds.tolist(),
            slope,
            torch.get_num_threads(),
        )
        ctx.save_for_backward(slope, thresholds.new_tensor(by))
        return brightness.new_tensor(total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        slope, by = ctx.saved_tensors
        by = by * upstream[0]
        by_offset = by[2] if ctx.needs_input_grad[2] and len(by) > 2 else None
        return slope * upstream[0], by[:2], by_offset, None, None, None, None, None


def _compared(
    brightness: Float[Tensor, "T H W"],
    thresholds: Float[Tensor, "2"],
    counts: Float[Tensor, "T-1 2 H W"],
    drift: Float[Tensor, "T-1 H W"] | None,
    sound: Tensor,
    weights: Float[Tensor, "T-1"],
    whole: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, "T H W"], Float[Tensor, "P"]]:
    """Value, and its slopes by the brightness and by thresholds and offset, in plain torch.

    The slope by the offset is left out where no ``drift`` tells it.
    """
    signed = thresholds * constant((1.0, -1.0), thresholds)
    reported = (signed[:, None, None] * counts).sum(1)
    wrong = brightness.diff(dim=0) - reported
    each = torch.cat([wrong, wrong.sum(0, keepdim=True)])
    weighed = torch.cat([weights, weights.new_tensor([whole])]).to(each.dtype)
    weighed = send(weighed, each.device)
    slopes = each.sign() * (sound * weighed[:, None, None])
    value = torch.dot(slopes.flatten(), each.flatten())
    by_wrong = slopes[:-1] + slopes[-1:]
    by = (by_wrong[:, None] * counts).sum((0, 2, 3)) * constant((-1.0, 1.0), by_wrong)
    if drift is not None:
        by = torch.cat([by, -(by_wrong * drift).sum()[None]])
    ends = torch.nn.functional.pad(by_wrong, (0, 0, 0, 0, 1, 1))
    return value, ends[:-1] - ends[1:], by


def _recorded(events: EventStore, frames: Sequence[Frame], interval_us: int) -> Span:
    """When events were recorded, by the first and the last; ALWAYS at an end that frames share.

    A sensor that sees nothing move is silent for a while: only where the first event comes, or the
    last went, more than `_SILENT_FRAMES` after the frames begin or before they end is the
    recording taken to begin or to end there. Of less, pictures tell (`unrecorded_spans`).
    """
    first, last = events.time_range_us
    mids = [frame.mid_us for frame in frames]
    late = first > min(mids) + _SILENT_FRAMES * interval_us
    early = last < max(mids) - _SILENT_FRAMES * interval_us
    return (first if late else ALWAYS[0]), (last if early else ALWAYS[1])


def _median_gap(times_us: Sequence[int]) -> int:
    ordered = sorted(times_us)
    gaps = sorted(b - a for a, b in zip(ordered, ordered[1:], strict=False))
    return gaps[len(gaps) // 2] if gaps else 0
