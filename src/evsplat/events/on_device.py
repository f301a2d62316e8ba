"""Counts of events that lie on a GPU, as `window_counts` has them; the host waits for none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from evsplat.devices import DeviceCache, constant, send
from evsplat.events.maps import event_pixels
from evsplat.events.store import EventStore, Span
from evsplat.events.stream import EventStream

_TIME_BITS = 32
_TIME = (1 << _TIME_BITS) - 1
_NOBODY = 1 << 62
_BLOCK_US = 200_000
"""Of events that are kept on a device together, eight bytes each."""


@dataclass(frozen=True, eq=False)
class DeviceEvents:
    """Consecutive events on a device."""

    keys: Int[Tensor, " N"]
    """Of `packed` events whose times, after ``origin_us``, ascend."""
    origin_us: int
    height: int
    width: int

    def window_counts(
        self, times_us: Sequence[int], within_us: Span, *, reach_us: int
    ) -> Float[Tensor, "T-1 2 H W"]:
        """As `evsplat.events.window_counts` of the events ``within_us``, which holds the times."""
        pixels, count = self.height * self.width, len(times_us)
        edges = self._sent([within_us[0], *times_us, within_us[1]])
        # Parts 0 and T + 2 lie outside, 1 and T + 1 before the first time and from the last one on.
        part = torch.searchsorted(edges, self.keys & _TIME, right=True)
        place = self.keys >> _TIME_BITS
        maps = self._sums(place.add(part, alpha=2 * pixels), None, count + 3)[2 : count + 1]
        if reach_us <= 0 or not len(part):
            return maps
        begun = self._begun(place, part, edges[1:-1], reach_us)
        return maps + begun[1:] - begun[:-1]

    def counts_around(self, spans_us: Sequence[Span]) -> Float[Tensor, "T 2 H W"]:
        """Number of ON and of OFF events in each span, which may overlap."""
        starts, ends = self._sent(np.transpose(spans_us).tolist())[..., None]
        after = self.keys & _TIME
        inside = (after >= starts) & (after < ends)
        maps = torch.arange(len(spans_us), device=inside.device)[:, None]
        place = maps * (2 * self.height * self.width) + (self.keys >> _TIME_BITS)
        return self._sums(place.flatten(), inside.flatten().float(), len(spans_us))

    def _begun(
        self,
        place: Int[Tensor, " N"],
        part: Int[Tensor, " N"],
        times: Int[Tensor, " T"],
        reach_us: int,
    ) -> Float[Tensor, "T 2 H W"]:
        """As `evsplat.events.begun_counts`: each pixel's last event before a time, its next one."""
        pixels, rows, count = self.height * self.width, len(times) + 3, len(part)
        index = (place % pixels).add(part, alpha=pixels)
        order = torch.arange(1, count + 1, device=part.device)
        last = order.new_zeros(rows * pixels).scatter_reduce_(0, index, order, "amax")
        first = order.new_full((rows * pixels,), count + 1).scatter_reduce_(0, index, order, "amin")
        last = last.view(rows, pixels)[1:-2].cummax(0).values
        first = first.view(rows, pixels)[2:-1].flip(0).cummin(0).values.flip(0)
        # Where there is none stands one at either end whose key is far from all others.
        keys = F.pad(self.keys, (1, 1), value=_NOBODY)
        before = keys[last]
        # Keys of two places or polarities lie farther apart than any reach.
        gap = keys[first] - before
        held = gap.clamp(1, reach_us)
        on = before < pixels << _TIME_BITS
        of_each = (on[:, None] == constant((True, False), on)[:, None]) & (gap == held)[:, None]
        begun = ((times[:, None] - (before & _TIME)) / held)[:, None] * of_each
        return begun.unflatten(-1, (self.height, self.width))

    def _sent(self, times_us: object) -> Int[Tensor, "..."]:
        """Times after the origin, on the device."""
        return send(torch.tensor(times_us) - self.origin_us, self.keys.device)

    def _sums(
        self, place: Int[Tensor, " N"], weights: Float[Tensor, " N"] | None, maps: int
    ) -> Float[Tensor, "M 2 H W"]:
        sums = torch.zeros(maps * 2 * self.height * self.width, device=place.device)
        if weights is None:
            weights = constant((1.0,), sums).expand(len(place))
        return sums.index_add_(0, place, weights).view(maps, 2, self.height, self.width)


class EventBlocks:
    """A recording's events in blocks, of which a `DeviceCache` keeps as many as it may."""

    def __init__(self, events: EventStore) -> None:
        """The cache's thread reads ``events``, and nobody else may at the same time."""
        self.events = events
        _ = events.has_polarity  # which is found by reading

    def prefetch(self, data: DeviceCache, start_us: int, end_us: int) -> None:
        """Bring events between two times to the device, which lie in one readable stretch."""
        for key in self._keys(start_us, end_us):
            data.prefetch(key, partial(self._block, *key[1:]))

    def between(self, data: DeviceCache, start_us: int, end_us: int) -> DeviceEvents:
        """At least the events between two times, which lie in one readable stretch."""
        keys = list(self._keys(start_us, end_us))
        origin = keys[0][1]
        blocks = [data.get(key, partial(self._block, *key[1:])) for key in keys]
        late = [block + (key[1] - origin) for key, block in zip(keys[1:], blocks[1:], strict=True)]
        joined = torch.cat([blocks[0], *late]) if late else blocks[0]
        return DeviceEvents(joined, origin, self.events.height, self.events.width)

    def _keys(self, start_us: int, end_us: int) -> Iterator[tuple[str, int, int]]:
        low, high = self.events.readable_around(start_us)
        for block in range(start_us // _BLOCK_US, -(-max(end_us, start_us + 1) // _BLOCK_US)):
            yield "events", max(block * _BLOCK_US, low), min((block + 1) * _BLOCK_US, high)

    def _block(self, start_us: int, end_us: int) -> Int[Tensor, " N"]:
        """Times after the start, and places in a map of both polarities, `packed`."""
        stream = self.events.between(start_us, end_us)
        return packed(stream, start_us, self.events.height, self.events.width)


def packed(stream: EventStream, origin_us: int, height: int, width: int) -> Int[Tensor, " N"]:
    """A number per event: its place in a flat map of both polarities, ON first, then its time.

    Times are those after ``origin_us``, where none may lie before it, in the lower 32 bits.
    """
    place = event_pixels(stream, height, width) + (stream.p < 0) * (height * width)
    return torch.from_numpy((place << _TIME_BITS) + (stream.t - origin_us))
