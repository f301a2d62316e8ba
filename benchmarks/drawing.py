"""How long a picture of a trained model takes on one core, against its limits.

    python benchmarks/drawing.py [RUN] [--sides 256 512 1080] [--pictures 40] [--threads 1]

The recording camera, stretched to each side, at times all over the recording one after another, as
a film or the viewer asks for them: the scene's backdrop is kept, the person is posed anew. Without
``RUN`` the demo capture is trained for 300 steps first. Milliseconds of CPU time over all threads,
which other work disturbs less than the clock; then where they go. Exit status 1 if a limit is
missed on one thread. The last line is JSON.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from step import Stopwatch

from evsplat.camera import Camera
from evsplat.models import drawing
from evsplat.models.discs import model as discs_model
from evsplat.render import Backdrop
from evsplat.shipped import demo_capture
from evsplat.training import load_run, train
from evsplat.training import reconstruction as run_module
from evsplat.training.reconstruction import GaussianReconstruction

LIMITS_MS = {256: 20.0, 512: 35.0, 1080: 90.0}
STEPS = 300
"""Of the demo, which has its full number of Gaussians and its networks by then."""


def main() -> None:
    """Print a line per side and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--sides", type=int, nargs="+", default=list(LIMITS_MS), metavar="PX")
    parser.add_argument("--pictures", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--save", type=Path, help="file for every 8th picture of each side")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.run or _trained(Path(folder) / "run")
        run = load_run(path, device="cpu")
    capture, made = run.capture, run.reconstruction
    frames = capture.frames
    times = torch.linspace(frames[0].mid_us, frames[-1].mid_us, arguments.pictures).int().tolist()
    shown = capture.camera(capture.train_frames[0])
    results: dict[str, float] = dict(run.gaussians) | {"threads": arguments.threads}
    pictures, missed = {}, False
    for side in arguments.sides:
        camera, drawn = stretched(shown, side), replace(made, backdrop=Backdrop())
        # What is kept from picture to picture is found by the first ones.
        pictures[side] = [drawn.render(camera, [at]).rgb[0].clone() for at in times[::8]]
        spent = milliseconds(drawn, camera, times)
        median, best = statistics.median(spent), min(spent)
        limit = LIMITS_MS.get(side)
        told = "" if limit is None else f", limit {limit:g}"
        parts = parts_of(drawn, camera, times)
        named = ", ".join(f"{part} {ms:.2f}" for part, ms in parts.items())
        print(f"{side:5d} px  {median:5.1f} ms (best {best:.1f}{told}): {named}", flush=True)
        results |= {f"median_{side}_ms": round(median, 2), f"best_{side}_ms": round(best, 2)}
        results |= {f"{part.replace(' ', '_')}_{side}_ms": round(v, 3) for part, v in parts.items()}
        missed |= arguments.threads == 1 and limit is not None and median > limit
    if arguments.save:
        torch.save(pictures, arguments.save)
    print(json.dumps(results))
    sys.exit(missed)


def _trained(out: Path) -> Path:
    train(demo_capture(), out=out, iterations=STEPS)
    return out


def stretched(camera: Camera, side: int) -> Camera:
    """The same view with ``side`` pixels along its longer side."""
    factor = side / max(camera.width, camera.height)
    K = camera.K.clone()
    K[:2] *= factor
    width, height = round(camera.width * factor), round(camera.height * factor)
    return replace(camera, K=K, width=width, height=height)


def milliseconds(made: GaussianReconstruction, camera: Camera, times: Sequence[int]) -> list[float]:
    """CPU time of each picture."""
    spent = []
    for at in times:
        start = time.process_time()
        made.render(camera, [at])
        spent.append(1e3 * (time.process_time() - start))
    return spent


def parts_of(
    made: GaussianReconstruction, camera: Camera, times: Sequence[int]
) -> dict[str, float]:
    """Milliseconds of a picture by part, mean over the times; "rest" is all that has no name."""
    watch, model = Stopwatch(time.process_time), made.model
    watched: list[tuple[Any, str, str]] = [
        (GaussianReconstruction, "render", "rest"),
        (model, "pose", "body pose"),
        (drawing, "_enlarge", "shadow enlarged"),
        (drawing, "render", "rasteriser"),
        (run_module, "draw", "drawing rest"),
    ]
    if isinstance(model, discs_model.DiscModel):
        watched += [
            (model.shade, "forward", "shade by the pose"),
            (discs_model, "skin_with_linear", "blend skinning"),
            (model, "_light", "light on the person"),
            (model, "_shadows", "shadow on the person"),
            (model, "_layers", "posing rest"),
        ]
        if model.shadow is not None:
            watched.append((model.shadow, "forward", "shadow on the scene"))
    with ExitStack() as stack:
        for owner, name, part in watched:
            stack.callback(setattr, owner, name, getattr(owner, name))
            watch.calls(owner, name, part)
        milliseconds(made, camera, times)
    longest_first = sorted(watch.forward.items(), key=lambda item: -item[1])
    return {part: 1e3 * seconds / len(times) for part, seconds in longest_first}


if __name__ == "__main__":
    main()
