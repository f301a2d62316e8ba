"""Train on the capture that ships, measure it, and draw one picture of it."""

from pathlib import Path

import evsplat as ev
from evsplat.shipped import demo_capture

OUT = Path("example_output")

# Twenty steps show how it goes; 2000 are worth looking at.
run = ev.train(demo_capture(), out=OUT / "run", iterations=20)

reconstruction = ev.load_run(run).reconstruction
capture = ev.load_capture(demo_capture())
frame = capture.test_frames[0]
drawn = reconstruction.render(capture.camera(frame), [frame.mid_us])
error = (drawn.rgb[0] - capture.sharp(frame)).square().mean()
print(f"frame {frame.name}: {-10 * error.log10():.2f} dB against the sharp truth")

print("written:", ev.render_run(run, out=OUT / "look.webp", seconds=0.4, fps=10, beside=True))
