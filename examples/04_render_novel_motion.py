"""Let a trained person do something that was never recorded, seen by a camera that swings."""

from pathlib import Path

import evsplat as ev
from evsplat.shipped import demo_capture

OUT = Path("example_output")

run = OUT / "run"  # of example 1
if not run.exists():
    run = ev.train(demo_capture(), out=run, iterations=20)

film = ev.render_run(
    run,
    out=OUT / "cartwheel.webp",
    motion="cartwheel",
    in_place=True,
    path="swing",
    seconds=1.5,
    fps=6,
)
print("written:", film)
film = ev.render_run(
    run, out=OUT / "person.webp", at=1.0, seconds=0.5, fps=8, path="orbit", parts="human",
    transparent=True,
)  # fmt: skip
print("written:", film)
