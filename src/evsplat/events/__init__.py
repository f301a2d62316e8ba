"""Event streams: recordings of any format, slices, maps, deblurring, a simulated sensor."""

from evsplat.events.edi import deblur
from evsplat.events.formats.base import RecordedFrame
from evsplat.events.homography import moved, read_homography
from evsplat.events.maps import (
    begun_counts,
    count_map,
    polarity_counts,
    time_surface,
    voxel_grid,
    window_counts,
)
from evsplat.events.recording import EventRecording, open_recording, read_events
from evsplat.events.simulator import (
    PRESETS,
    SensorSettings,
    SensorSimulator,
    sensor_settings,
    simulate_events,
)
from evsplat.events.store import ALWAYS, EventStore, Span
from evsplat.events.stream import EventStream
from evsplat.events.write import write_events

__all__ = [
    "ALWAYS",
    "PRESETS",
    "EventRecording",
    "EventStore",
    "EventStream",
    "RecordedFrame",
    "SensorSettings",
    "SensorSimulator",
    "Span",
    "begun_counts",
    "count_map",
    "deblur",
    "moved",
    "open_recording",
    "polarity_counts",
    "read_events",
    "read_homography",
    "sensor_settings",
    "simulate_events",
    "time_surface",
    "voxel_grid",
    "window_counts",
    "write_events",
]
