"""Counts of events that lie on a GPU, as `window_counts` has them; the host waits for none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.devices import DeviceCache, send
from evsplat.events.maps import event_pixels
from evsplat.events.store import EventStore, Span

_BLOCK_US = 200_000
"""Of events that are kept on a device together, eight bytes each."""


@dataclass(frozen=True, eq=False)
class DeviceEvents:
    """Consecutive events on a device."""

    after_us: Int[Tensor, " N"]
    """Time after ``origin_us``, ascending."""
    place: Int[Tensor, " N"]
    """In a flat map of both polarities, ON first."""
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
        part = torch.searchsorted(edges, self.after_us, right=True)
        maps = self._sums(part * (2 * pixels) + self.place, None, count + 3)[2 : count + 1]
        if reach_us <= 0 or not len(part):
            return maps
        begun = self._begun(part, edges[1:-1], reach_us)
        return maps + begun[1:] - begun[:-1]

    def counts_around(self, spans_us: Sequence[Span]) -> Float[Tensor, "T 2 H W"]:
        """Number of ON and of OFF events in each span, which may overlap."""
        starts, ends = self._sent(np.transpose(spans_us).tolist())[..., None]
        inside = (self.after_us >= starts) & (self.after_us < ends)
        maps = torch.arange(len(spans_us), device=inside.device)[:, None]
        place = maps * (2 * self.height * self.width) + self.place
        return self._sums(place.flatten(), inside.flatten().float(), len(spans_us))

    def _begun(
        self, part: Int[Tensor, " N"], times: Int[Tensor, " T"], reach_us: int
    ) -> Float[Tensor, "T 2 H W"]:
        """As `evsplat.events.begun_counts`: each pixel's last event before a time, its next one."""
        pixels, rows, count = self.height * self.width, len(times) + 3, len(part)
        index = part * pixels + self.place % pixels
        order = torch.arange(count, device=part.device)
        last = order.new_full((rows * pixels,), -1).scatter_reduce_(0, index, order, "amax")
        first = order.new_full((rows * pixels,), count).scatter_reduce_(0, index, order, "amin")
        last = last.view(rows, pixels)[1:-2].cummax(0).values
        first = first.view(rows, pixels)[2:-1].flip(0).cummin(0).values.flip(0)
        before, after = last.clamp_min(0), first.clamp_max(count - 1)
        place, since = self.place[before], self.after_us[before]
        gap = self.after_us[after] - since
        known = (last >= 0) & (first < count) & (place == self.place[after]) & (gap <= reach_us)
        shares = torch.where(known, (times[:, None] - since).double() / gap, 0.0).float()
        off = place >= pixels
        begun = torch.stack([shares.masked_fill(off, 0.0), shares.masked_fill(~off, 0.0)], 1)
        return begun.unflatten(-1, (self.height, self.width))

    def _sent(self, times_us: object) -> Int[Tensor, "..."]:
        """Times after the origin, on the device."""
        after = (torch.tensor(times_us) - self.origin_us).to(torch.int32)
        return send(after, self.place.device)

    def _sums(
        self, place: Int[Tensor, " N"], weights: Float[Tensor, " N"] | None, maps: int
    ) -> Float[Tensor, "M 2 H W"]:
        sums = torch.zeros(maps * 2 * self.height * self.width, device=place.device)
        if weights is None:
            weights = torch.ones((), device=place.device).expand(len(place))
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
        times = [block[0] + (key[1] - origin) for key, block in zip(keys, blocks, strict=True)]
        places = torch.cat([block[1] for block in blocks])
        return DeviceEvents(torch.cat(times), places, origin, self.events.height, self.events.width)

    def _keys(self, start_us: int, end_us: int) -> Iterator[tuple[str, int, int]]:
        low, high = self.events.readable_around(start_us)
        for block in range(start_us // _BLOCK_US, -(-max(end_us, start_us + 1) // _BLOCK_US)):
            yield "events", max(block * _BLOCK_US, low), min((block + 1) * _BLOCK_US, high)

    def _block(self, start_us: int, end_us: int) -> Int[Tensor, "2 N"]:
        """Times after the start, and places in a map of both polarities."""
        stream = self.events.between(start_us, end_us)
        height, width = self.events.height, self.events.width
        place = event_pixels(stream, height, width) + (stream.p < 0) * (height * width)
        return torch.from_numpy(np.stack([stream.t - start_us, place]).astype(np.int32))
