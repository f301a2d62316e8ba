"""Event streams: slices in memory, recordings on disk and maps of signed counts."""

from evsplat.events.maps import count_map
from evsplat.events.store import EventStore
from evsplat.events.stream import EventStream
from evsplat.events.write import write_events

__all__ = ["EventStore", "EventStream", "count_map", "write_events"]
