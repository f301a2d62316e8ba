"""Events at full time resolution: brightness change between any two rendered times."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.capture import Capture, Frame
from evsplat.devices import send
from evsplat.events import EventStream, polarity_counts
from evsplat.imaging import luminance
from evsplat.objectives.base import Stateless, Step


class ContrastThresholds(nn.Module):
    """How much the logarithm of brightness changes per event, for either polarity; learned.

    Events alone would have them shrink: the mean absolute difference to a change that is not yet
    reconstructed is smallest when events mean little. `apart` is what holds them.
    """

    start_logs: Tensor

    def __init__(self, on: float, off: float) -> None:
        """Thresholds to start from and to stay near, above 0."""
        super().__init__()
        self.register_buffer("start_logs", torch.tensor([on, off]).log())
        self.logs = nn.Parameter(self.start_logs.clone())

    def apart(self) -> Float[Tensor, ""]:
        """Squared distance of the logarithms from where they started, mean over polarities."""
        return (self.logs - self.start_logs).square().mean()

    def change(
        self, on: Float[Tensor, "*shape"], off: Float[Tensor, "*shape"]
    ) -> Float[Tensor, "*shape"]:
        """Log-brightness change that counts of events of both polarities report."""
        threshold = self.logs.exp()
        return threshold[0] * on - threshold[1] * off


class EventWindows(Stateless):
    """Mean absolute difference between rendered change and events, amplitude kept (eq. 3).

    Windows lie between neighbouring rendered times and from the first to the last. Besides the
    times of other objectives one more is asked for, at random before or after the exposure, within
    ``reach`` frame intervals, so that the gaps between exposures teach as well. All pixels count:
    where there is no event, nothing changed.
    """

    def __init__(
        self,
        capture: Capture,
        thresholds: ContrastThresholds,
        generator: torch.Generator,
        *,
        start: float,
        eps: float,
        reach: float = 0.5,
    ) -> None:
        """``start`` in nominal iterations; ``eps`` is added to linear luminance."""
        assert capture.events is not None
        self.events, self.thresholds, self.generator = capture.events, thresholds, generator
        self.start, self.eps, self.reach = start, eps, reach
        mids = sorted(frame.mid_us for frame in capture.frames)
        gaps = sorted(b - a for a, b in zip(mids, mids[1:], strict=False))
        self.interval_us = gaps[len(gaps) // 2] if gaps else 0
        self.range_us = (mids[0], mids[-1])

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """One time outside of the exposure."""
        if nominal < self.start:
            return ()
        draw = torch.rand(2, generator=self.generator).tolist()
        start, end = frame.exposure_us
        far = int(draw[0] * self.reach * self.interval_us)
        time = start - 1 - far if draw[1] < 0.5 else end + far
        return (min(max(time, self.range_us[0]), self.range_us[1]),)

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``event``: mean over windows, pixels and the whole span; ``contrast``: `apart`."""
        if step.nominal < self.start or len(step.times_us) < 2:
            return {}
        times = step.times_us
        stream = self.events.between(times[0], times[-1])
        brightness = torch.log(luminance(step.linear) + self.eps)
        on, off = send(self._counts(stream, times), brightness.device).unbind(1)
        reported = self.thresholds.change(on, off)
        changes = brightness[1:] - brightness[:-1]
        windows = (changes - reported).abs().mean()
        whole = (brightness[-1] - brightness[0] - reported.sum(0)).abs().mean()
        return {"event": 0.5 * (windows + whole), "contrast": self.thresholds.apart()}

    def _counts(self, stream: EventStream, times: Sequence[int]) -> Float[Tensor, "T-1 2 H W"]:
        """Events per window, polarity (brighter first) and pixel."""
        size = self.events.height, self.events.width
        windows = zip(times, times[1:], strict=False)
        return torch.stack([polarity_counts(stream.between(*ends), *size) for ends in windows])
