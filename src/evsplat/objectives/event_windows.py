"""Events at full time resolution: brightness change between any two rendered times."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Capture, Frame
from evsplat.devices import send
from evsplat.events import EventStream, begun_counts, polarity_counts
from evsplat.imaging import luminance
from evsplat.objectives.base import Stateless, Step
from evsplat.objectives.event_noise import EventNoise
from evsplat.objectives.event_sensor import EventSensor

_RATE_US = 1_000
"""How far before and after an instant events are counted for their rate there."""


class EventWindows(Stateless):
    """Mean absolute difference between rendered change and events, amplitude kept (eq. 3).

    Windows lie between neighbouring rendered times and from the first to the last. Besides the
    times of other objectives one more is asked for, at random before or after the exposure, within
    ``reach`` intervals of the training frames, so that the gaps between exposures teach as well.
    All pixels count: where there is no event, nothing changed.

    Events that nothing caused are allowed for: differences weigh by the noise of their time
    (`EventNoise`), and hot pixels do not count.

    Where events have no polarity the size of the change is compared with their number, between
    neighbouring times only: over a longer span what went up and down again is in the number alone.
    """

    def __init__(
        self,
        capture: Capture,
        sensor: EventSensor,
        generator: torch.Generator,
        *,
        start: float,
        eps: float,
        noise: EventNoise,
        reach: float = 0.5,
        begun_us: int = 0,
    ) -> None:
        """``start`` in nominal iterations; ``eps`` is added to linear luminance.

        Between events of one polarity at most ``begun_us`` apart brightness changes evenly
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
        self.begun_us = begun_us

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """One time outside of the exposure."""
        if nominal < self.start:
            return ()
        draw = torch.rand(2, generator=self.generator).tolist()
        start, end = frame.exposure_us
        far = int(draw[0] * self.reach_us)
        time = start - 1 - far if draw[1] < 0.5 else end + far
        return (min(max(time, self.range_us[0]), self.range_us[1]),)

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: mean over windows, pixels and the whole span; ``contrast``: `apart`."""
        times = step.times_us
        if step.nominal < self.start or len(times) < 2:
            return {}
        wrong = self.differences(step)
        event = self.mean(
            wrong, [end - start for start, end in zip(times, times[1:], strict=False)]
        )
        if self.events.has_polarity:
            event = 0.5 * (event + self.mean(wrong.sum(0, keepdim=True), [times[-1] - times[0]]))
        return {"event": event, "contrast": self.sensor.apart()}

    def differences(self, step: Step) -> Float[Tensor, "T-1 H W"]:
        """Rendered less reported change of log-brightness between neighbouring times.

        Without polarity: of the change's size.
        """
        offset = self.sensor.offset_us
        shift = 0 if offset is None else round(float(offset))
        late = [time + shift for time in step.times_us]
        brightness = torch.log(luminance(step.linear) + self.eps)
        reach = max(_RATE_US, self.begun_us)
        stream = self.events.between(late[0] - reach, late[-1] + reach)
        windows = list(zip(late, late[1:], strict=False))
        counts = self._counts(stream, windows, brightness.device)
        changes = brightness[1:] - brightness[:-1]
        if not self.events.has_polarity:
            return changes.abs() - self.sensor.path(counts.sum(1))
        if self.begun_us > 0:
            size = self.events.height, self.events.width
            begun = begun_counts(stream, late, *size, reach_us=self.begun_us)
            counts = counts + send(begun[1:] - begun[:-1], counts.device)
        reported = self.sensor.change(*counts.unbind(1))
        if offset is not None:
            # Events per microsecond at each instant tell what a later clock would have counted.
            around = [(time - _RATE_US, time + _RATE_US) for time in late]
            rates = self.sensor.change(*self._counts(stream, around, brightness.device).unbind(1))
            rates = rates.detach() / (2 * _RATE_US)
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


def _median_gap(times_us: Sequence[int]) -> int:
    ordered = sorted(times_us)
    gaps = sorted(b - a for a, b in zip(ordered, ordered[1:], strict=False))
    return gaps[len(gaps) // 2] if gaps else 0
