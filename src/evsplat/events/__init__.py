"""Event streams: recordings of any format, slices in memory, stores on disk, maps of counts."""

from evsplat.events.formats.base import RecordedFrame
from evsplat.events.maps import count_map
from evsplat.events.recording import EventRecording, open_recording, read_events
from evsplat.events.store import EventStore
from evsplat.events.stream import EventStream
from evsplat.events.write import write_events

__all__ = [
    "EventRecording",
    "EventStore",
    "EventStream",
    "RecordedFrame",
    "count_map",
    "open_recording",
    "read_events",
    "write_events",
]
