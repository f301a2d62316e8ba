"""The event camera in training: its noise, learned contrast thresholds, a clock that runs apart."""

import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.calibration import noise_of
from evsplat.events import EventStore
from evsplat.events.store import ALWAYS, Span

_OFFSET_UNIT_US = 10_000.0
"""One unit of the offset's parameter, so that all parameters learn well at one rate."""


class EventSensor(nn.Module):
    """Change of log-brightness per event of either polarity, and the lag of the events' clock.

    Events alone would have thresholds shrink: the mean absolute difference to a change that is not
    yet reconstructed is smallest when events mean little. `apart` is what holds them.
    """

    start_logs: Tensor

    def __init__(
        self,
        on: float,
        off: float,
        *,
        late_us: float | None = None,
    ) -> None:
        """Thresholds to start from and to stay near, above 0.

        The offset of the events' clock is learned from ``late_us`` on, unless that is None.
        """
        super().__init__()
        self.register_buffer("start_logs", torch.tensor([on, off]).log())
        self.logs = nn.Parameter(self.start_logs.clone())
        self.offset = nn.Parameter(torch.tensor((late_us or 0.0) / _OFFSET_UNIT_US))
        self.learns_clock = late_us is not None

    @property
    def offset_us(self) -> Float[Tensor, ""] | None:
        """Lag of the events behind the frames' clock, microseconds; None: not learned."""
        return _OFFSET_UNIT_US * self.offset if self.learns_clock else None

    def get_extra_state(self) -> Tensor:
        """True if the clock is learned: a saved run says so itself."""
        return torch.tensor(self.learns_clock)

    def set_extra_state(self, state: Tensor) -> None:
        """Take back what `get_extra_state` gave."""
        self.learns_clock = bool(state)

    def apart(self) -> Float[Tensor, ""]:
        """Squared distance of the logarithms from where they started, mean over polarities."""
        return nn.functional.mse_loss(self.logs, self.start_logs)

    def change(
        self, on: Float[Tensor, "*batch H W"], off: Float[Tensor, "*batch H W"]
    ) -> Float[Tensor, "*batch H W"]:
        """Log-brightness change that counts of events of both polarities report."""
        threshold = self.thresholds
        return threshold[0] * on - threshold[1] * off

    @property
    def thresholds(self) -> Float[Tensor, "2"]:
        """Change of log-brightness per event, ON and OFF, above 0."""
        return self.logs.exp()

    def path(self, count: Float[Tensor, "*batch H W"]) -> Float[Tensor, "*batch H W"]:
        """Size of the log-brightness change that counts of events without polarity report."""
        return self.logs.mean().exp() * count


class EventNoise:
    """Background activity, and the pixels that fire without cause; measured once (`measure`).

    With a background rate r an interval T holds r T events per pixel that nothing caused, give or
    take the root: what is compared with its events weighs ``1 / (1 + 2 sqrt(r T))``, as a Laplace
    likelihood does whose width is half a threshold and that noise.
    """

    def __init__(self, events: EventStore, *, during_us: Span = ALWAYS, aware: bool = True) -> None:
        """Noise of a recording ``during_us``; without ``aware`` every event counts fully."""
        self.events, self.during_us, self.aware = events, during_us, aware

    def measure(self) -> None:
        """Measure now what is else measured when it is first asked for: it takes seconds."""
        _ = self._measured

    @cached_property
    def _measured(self) -> tuple[float, Float[Tensor, "H W"]]:
        sound = torch.ones(self.events.height, self.events.width)
        if not self.aware:
            return 0.0, sound
        noise = noise_of(self.events, self.during_us)
        sound[noise.hot_pixels[:, 1], noise.hot_pixels[:, 0]] = 0.0
        return noise.background_hz, sound

    @property
    def sound(self) -> Float[Tensor, "H W"]:
        """0 at hot pixels, 1 elsewhere."""
        return self._measured[1]

    def weight(self, duration_us: int) -> float:
        """Weight, in 0..1, of what is compared with the events of so many microseconds."""
        return 1 / (1 + 2 * math.sqrt(self._measured[0] * duration_us * 1e-6))
