"""Read events, cut a window out of them, draw it, and write them in another format."""

from pathlib import Path

from PIL import Image

import evsplat as ev
from evsplat.events import count_map, voxel_grid, write_events
from evsplat.pictures import signed_map
from evsplat.shipped import demo_capture

OUT = Path("example_output")
OUT.mkdir(exist_ok=True)

capture = ev.load_capture(demo_capture())
frame = capture.frames[5]
start_us, end_us = frame.exposure_us
events = capture.events.between(start_us, end_us)  # read from disk, this window alone
seconds = (end_us - start_us) / 1e6
print(f"{len(events):,} events in {seconds * 1e3:g} ms: {len(events) / seconds:,.0f} a second")
print(f"brighter: {(events.p > 0).mean():.0%}")

height, width = capture.events.height, capture.events.width
picture = signed_map(count_map(events, height, width), full_scale=4)
Image.fromarray(picture).save(OUT / "events.png")
print("voxel grid:", tuple(voxel_grid(events, height, width, bins=5).shape))
write_events(OUT / "window.csv", events, width=width, height=height)
