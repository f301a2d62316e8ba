"""Trust in a recording's events, per pixel and per time they are counted over."""

import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.calibration import noise_of
from evsplat.events import EventStore


class EventNoise:
    """Background activity, and the pixels that fire without cause; measured when first asked for.

    With a background rate r an interval T holds r T events per pixel that nothing caused, give or
    take the root: what is compared with its events weighs ``1 / (1 + 2 sqrt(r T))``, as a Laplace
    likelihood does whose width is half a threshold and that noise.
    """

    def __init__(self, events: EventStore, *, aware: bool = True) -> None:
        """Noise of a whole recording; not ``aware`` of it, every event counts fully."""
        self.events, self.aware = events, aware

    @cached_property
    def _measured(self) -> tuple[float, Float[Tensor, "H W"]]:
        sound = torch.ones(self.events.height, self.events.width)
        if not self.aware:
            return 0.0, sound
        noise = noise_of(self.events)
        sound[noise.hot_pixels[:, 1], noise.hot_pixels[:, 0]] = 0.0
        return noise.background_hz, sound

    @property
    def sound(self) -> Float[Tensor, "H W"]:
        """0 at hot pixels, 1 elsewhere."""
        return self._measured[1]

    def weight(self, duration_us: int) -> float:
        """Weight of what is compared with the events of so many microseconds, in 0..1."""
        return 1 / (1 + 2 * math.sqrt(self._measured[0] * duration_us * 1e-6))
