"""An event camera in software: pictures of linear light in, events out (see docs/simulator.md)."""

from evsplat.events.simulator.sensor import SensorSimulator, simulate_events
from evsplat.events.simulator.settings import PRESETS, SensorSettings, sensor_settings

__all__ = ["PRESETS", "SensorSettings", "SensorSimulator", "sensor_settings", "simulate_events"]
