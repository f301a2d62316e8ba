"""Learned properties of the event camera: contrast thresholds and a clock that runs apart."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

_OFFSET_UNIT_US = 10_000.0
"""One unit of the offset's parameter, so that all parameters learn well at one rate."""


class EventSensor(nn.Module):
    """Change of log-brightness per event, for either polarity, and delay of the events.

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
        """Delay of the events' stamps against the frames' clock; None: not learned."""
        return _OFFSET_UNIT_US * self.offset if self.learns_clock else None

    def get_extra_state(self) -> Tensor:
        """Whether the clock is learned: a saved run says so itself."""
        return torch.tensor(self.learns_clock)

    def set_extra_state(self, state: Tensor) -> None:
        """Take back what `get_extra_state` gave."""
        self.learns_clock = bool(state)

    def apart(self) -> Float[Tensor, ""]:
        """Squared distance of the logarithms from where they started, mean over polarities."""
        return (self.logs - self.start_logs).square().mean()

    def change(
        self, on: Float[Tensor, "*batch H W"], off: Float[Tensor, "*batch H W"]
    ) -> Float[Tensor, "*batch H W"]:
        """Log-brightness change that counts of events of both polarities report."""
        threshold = self.logs.exp()
        return threshold[0] * on - threshold[1] * off

    def path(self, count: Float[Tensor, "*batch H W"]) -> Float[Tensor, "*batch H W"]:
        """Way of log-brightness, up or down, when events do not say which."""
        return self.logs.mean().exp() * count
