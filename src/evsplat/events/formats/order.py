"""Events in the order of their times: an error, or sorted, with what that mixes."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from evsplat.events.formats.base import BLOCK_EVENTS, Damage, parts_said
from evsplat.events.stream import EventStream

_SORTS = "sorts events that are out of order"
_LEAVES_OUT = "leaves out events too late to be sorted in"
_JUMP_US, _STRETCH_EVENTS = 1_000, 32
"""A clock jumped if it fell by so much and at least so many events follow from there on; sensors
that are read row by row are out of order by less, and a packet that came late fills a gap."""
_ANEW_US = 100_000
"""By which a clock falls that begins anew; packets come late by less."""
_OWN_ORDER, _SHARED = 0.01, 0.1
"""Shares of those events: of the most that fall again, by a tenth of the jump, as at random
delays; and of earlier events at the same times, from which on both are mixed."""


class Block(NamedTuple):
    """Events as they follow in a file."""

    first: int
    """Index of its first event in the file."""
    stream: EventStream
    rising: bool
    """True where its times are known to be in order, from the event before it on."""


def ascending(blocks: Iterable[Block], damage: Damage) -> Iterator[EventStream]:
    """The blocks as they are; an error where time goes back."""
    last_us: int | None = None
    for first, block, rising in blocks:
        if not rising:
            previous = np.concatenate([[block.t[0] if last_us is None else last_us], block.t[:-1]])
            falls = block.t < previous
            at = int(np.argmax(falls))
            found = (
                f"event {first + at} is at {block.t[at]} us, after one at {previous[at]} us "
                f"({int(falls.sum())} steps back among events {first} to {first + len(falls) - 1})"
            )
            if previous[at] - block.t[at] >= _ANEW_US:
                found += (
                    f", as of two recordings in one file: {parts_said(damage.path, first + at)}"
                )
            damage.found(found, repaired_by=_SORTS)
        last_us = int(block.t[-1])
        yield block


def in_order(blocks: Iterable[Block], damage: Damage) -> Iterator[EventStream]:
    """All but the latest `BLOCK_EVENTS` of what was read so far, sorted; then the rest."""
    held: EventStream | None = None
    last_us: int | None = None
    back = _WayBack(damage)
    for _, block, _ in blocks:
        back.look(block.t, last_us, None if held is None else held.t)
        if last_us is not None and len(block) and int(block.t.min()) < last_us:
            on_time = block.t >= last_us
            damage.found(
                "events out of order by more than a block",
                repaired_by=_LEAVES_OUT,
                count=len(block) - int(on_time.sum()),
            )
            block = block.take(on_time)
        merged = block if held is None else EventStream.joined([held, block])
        falls = int((np.diff(merged.t) < 0).sum())
        if falls:
            damage.found("events out of order", repaired_by=_SORTS, count=falls)
            merged = merged.take(np.argsort(merged.t, kind="stable"))
        ready = max(0, len(merged) - BLOCK_EVENTS)
        if ready:
            last_us = int(merged.t[ready - 1])
            yield merged.take(slice(0, ready))
        held = merged.take(slice(ready, None))
    if held is not None and len(held):
        yield held


class _WayBack:
    """How far times go back, and whether a stretch of events goes on from there at times of others.

    Single events that come late are told from a clock that jumped: after that one, times rise by
    themselves, behind the latest one before, until they have caught up.
    """

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._latest_us: int | None = None
        self._deepest_us = 0
        self._jump: tuple[int, int] | None = None
        """Where the deepest jump that mixes stretches falls from, and by how much, us."""
        self._mixed = 0

    def look(
        self,
        t: Int64[np.ndarray, "N"],
        gone_until_us: int | None,
        held_t: Int64[np.ndarray, "M"] | None,
    ) -> None:
        """Note the times of the next block; earlier ones are sorted, handed on or still held."""
        if not len(t):
            return
        latest = int(t[0]) if self._latest_us is None else self._latest_us
        before = np.maximum.accumulate(np.concatenate([[latest], t[:-1]]))
        self._latest_us = max(int(before[-1]), int(t[-1]))
        behind_us = before - t
        worst = int(behind_us.argmax())
        if behind_us[worst] > self._deepest_us:
            self._deepest_us = int(behind_us[worst])
            self._damage.details[_SORTS] = (
                f"by {self._deepest_us:,} us at most, after {before[worst]:,} us"
            )
        stretch = _longest_stretch(t, behind_us)
        if stretch is None:
            return
        start, stop = stretch
        low, high = int(t[start:stop].min()), int(t[start:stop].max())
        shared = int(((t[:start] >= low) & (t[:start] <= high)).sum())
        if held_t is not None:
            shared += int(np.searchsorted(held_t, high, "right") - np.searchsorted(held_t, low))
        # Of those that were handed on only the last time is known.
        was_handed_on = gone_until_us is not None and low < gone_until_us
        if not was_handed_on and shared < max(_STRETCH_EVENTS, _SHARED * (stop - start)):
            return
        self._mixed += stop - start
        deepest = start + int(behind_us[start:stop].argmax())
        if self._jump is None or behind_us[deepest] > self._jump[1]:
            self._jump = int(before[deepest]), int(behind_us[deepest])
        from_us, by_us = self._jump
        self._damage.warnings[_SORTS] = (
            f"the clock of the events jumps back by {by_us:,} us at {from_us:,} us, and "
            f"{self._mixed:,} events after that are at times of others before it: what is sorted "
            "mixes two stretches of the recording; unless both belong together, cut the file there "
            "and give the part that belongs to the pictures"
        )


def _longest_stretch(
    t: Int64[np.ndarray, "N"], behind_us: Int64[np.ndarray, "N"]
) -> tuple[int, int] | None:
    """First event and one past the last of the longest row of events after a jump of the clock."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], behind_us > 0, [0]])))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return None
    depths = np.maximum.reduceat(behind_us, starts)
    lengths = np.where(depths >= _JUMP_US, stops - starts, 0)
    longest = int(lengths.argmax())
    if lengths[longest] < _STRETCH_EVENTS:
        return None
    start, stop = int(starts[longest]), int(stops[longest])
    falls = int((np.diff(t[start:stop]) < -0.1 * depths[longest]).sum())
    # The jump itself may come after a step back of another kind.
    return (start, stop) if falls <= 1 + _OWN_ORDER * (stop - start) else None
