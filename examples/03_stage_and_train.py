"""Film a synthetic person with complete ground truth, then train on it."""

import shutil
from pathlib import Path

import evsplat as ev

OUT = Path("example_output")
shutil.rmtree(OUT / "kick", ignore_errors=True)

path = ev.stage(
    OUT / "kick", character="woman", motion="kick", width=96, height=96, frames=10, in_place=True
)
capture = ev.load_capture(path)
print(
    f"{capture.name}: {len(capture.train_frames)} training frames, {len(capture.events):,} events"
)

run = ev.train(path, out=OUT / "kick_run", iterations=20)
print("run:", run)
