"""Event streams: slices in memory, recordings on disk and maps of signed counts."""

from evsplat.events.maps import count_map
from evsplat.events.store import EventStore, write_events
from evsplat.events.stream import EventStream

__all__ = ["EventStore", "EventStream", "count_map", "write_events"]
