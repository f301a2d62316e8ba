"""Memory and start of a run by the length of its recording: 20 steps after 1, 10 and 60 minutes.

    python benchmarks/length.py [--minutes 1 10 60] [--steps 20] [--visit 2500] [--events 54e6]
        [--erring]

The recording is the demo capture again and again, with one of so many of its events that at most
``--events`` are left: about as many at every length, so that what is kept of them decoded is full
at each. It is written in pieces, and each training runs in a process of its own, so
that its peak memory is its own: Python and PyTorch are about 300 MB of it, the model the same
at every length. Beside the steps the pictures, silhouettes and events of up to ``--visit`` training
frames are read, evenly spread, which fills every cache as a long training does. With ``--erring``
the poses err by 0.03 rad and say so. Printed for each
length: frames, events, seconds to the first step (reading, checks, estimates and the fits before
training), CPU time of a step, and peak memory. The last line is JSON.
"""

import evsplat as ev

# isort: split
import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

from evsplat.devices import use_threads
from evsplat.objectives import RenderedSemantics
from evsplat.objectives.event_windows import EventWindows
from evsplat.shipped import demo_capture
from evsplat.training.trainer import Trainer

_US = 60_000_000


def main() -> None:
    """Run every length, or with ``--run`` one training in this process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 10.0, 60.0])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--visit", type=int, default=2_500, metavar="N", help="frames")
    parser.add_argument("--events", type=float, default=54e6, metavar="N", help="at most")
    parser.add_argument("--erring", action="store_true", help="poses that err, and say so")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        use_threads(options.threads)
        print(json.dumps(one_training(options.run, options.steps, options.visit)))
        return
    points = []
    for minutes in options.minutes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "capture"
            frames, events = write_recording(
                path, minutes, int(options.events), erring=options.erring
            )
            command = [sys.executable, __file__, "--run", str(path)]
            for name in ("steps", "visit", "threads"):
                command += [f"--{name}", str(getattr(options, name))]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
            point = {"minutes": minutes, "frames": frames, "events": events}
            points.append(point | json.loads(done.stdout.splitlines()[-1]))
        print(
            f"{minutes:6g} min  {frames:6,d} frames  {events:12,d} events  first step after "
            f"{points[-1]['first_step_s']:6.1f} s ({points[-1]['first_step_cpu_s']:.1f} of CPU)  "
            f"step {points[-1]['step_cpu_ms']} ms of CPU  peak {points[-1]['peak_rss_mb']:6,d} MB",
            flush=True,
        )
    print(json.dumps({"steps": options.steps, "threads": options.threads, "points": points}))


def one_training(capture: Path, steps: int, visited: int) -> dict[str, float]:
    """Seconds until the first step and peak memory of a training of ``steps``."""
    started, first, spent = time.perf_counter(), [], []
    step = Trainer.step

    def noted(self: Trainer) -> object:
        first.append((time.perf_counter() - started, time.process_time()))
        report = step(self)
        spent.append(1e3 * (time.process_time() - first[-1][1]))
        if len(first) == steps:
            fill_caches(self, visited)
        return report

    Trainer.step = noted  # type: ignore[method-assign, assignment]
    ev.train(capture, out=capture.parent / "run", iterations=steps)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "first_step_s": round(first[0][0], 1),
        "first_step_cpu_s": round(first[0][1], 1),
        "step_cpu_ms": round(statistics.median(spent)),
        "peak_rss_mb": round(peak / 1e3),
    }


def fill_caches(trainer: Trainer, visited: int) -> None:
    """Read what steps of so many frames would read."""
    frames = trainer.capture.train_frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(visited, len(frames))).round())
    for frame in (frames[int(number)] for number in chosen):
        trainer.capture.image(frame)
        for objective in trainer.composition.objectives:
            if isinstance(objective, RenderedSemantics):
                objective.bounds[frame.camera, frame.mid_us]()
            if isinstance(objective, EventWindows):
                objective.events.between(*frame.exposure_us)


def write_recording(
    folder: Path, minutes: float, most: int, *, erring: bool = False
) -> tuple[int, int]:
    """The demo capture again and again for so long, thinned to ``most`` events; what there is."""
    shutil.copytree(demo_capture(), folder)
    metadata = json.loads((folder / "capture.json").read_text())
    frames, metadata["novel_views"] = metadata["frames"], []
    body = dict(np.load(folder / "body.npz"))
    period = int(2 * body["times_us"][-1] - body["times_us"][-2] - body["times_us"][0])
    turns = max(1, round(minutes * _US / period))
    metadata["frames"] = []
    for number in range(turns * len(frames)):
        turn, frame = number // len(frames), frames[number % len(frames)]
        name = f"{number:06d}"
        picture = f"images/{name}{Path(frame['image']).suffix}"
        # links: a picture lies on the disk once
        os.link(folder / frame["image"], folder / f"{picture}.new")
        span = [at + turn * period for at in frame["exposure_us"]]
        entry = {"name": name, "image": picture, "exposure_us": span}
        kept = {key: frame[key] for key in ("camera", "split") if key in frame}
        metadata["frames"].append(entry | kept)
    for link in folder.glob("images/*.new"):
        link.replace(link.with_suffix(""))
    if erring:
        metadata["body"]["source"] = "estimated"
    (folder / "capture.json").write_text(json.dumps(metadata))
    body["times_us"] = np.concatenate([body["times_us"] + turn * period for turn in range(turns)])
    for name in ("poses", "transl"):
        body[name] = np.concatenate([body[name]] * turns)
    if erring:
        keys, joints = body["poses"].shape[:2]
        body["poses"] += np.random.default_rng(0).normal(0, 0.03, body["poses"].shape)
        body["pose_std_rad"] = np.full((keys, joints), 0.03, np.float32)
        body["transl_std_m"] = np.full((keys, 3), 0.01, np.float32)
    np.savez(folder / "body.npz", **body)
    return len(metadata["frames"]), _write_events(folder / "events.h5", period, turns, most)


def _write_events(path: Path, period_us: int, turns: int, most: int) -> int:
    """The file's events, thinned, ``turns`` times in a row, in its place; gives their number."""
    with h5py.File(path, "r") as file:
        events = {name: file["events"][name][:] for name in "txyp"}
        offset = int(file["t_offset"][()])
    events = {name: values[events["t"] < period_us] for name, values in events.items()}
    keep = max(1, -(-turns * len(events["t"]) // most))
    events = {name: values[::keep] for name, values in events.items()}
    count, ms = len(events["t"]), np.arange(turns * period_us // 1000 + 2)
    path.unlink()
    with h5py.File(path, "w") as file:
        for name, values in events.items():
            stored = file.create_dataset(
                f"events/{name}", (count * turns,), values.dtype, chunks=(1 << 16,)
            )
            for turn in range(turns):
                moved = values + values.dtype.type(turn * period_us) if name == "t" else values
                stored[turn * count : (turn + 1) * count] = moved
        before, within = np.divmod(1000 * ms, period_us)
        rows = before * count + np.searchsorted(events["t"], within)
        file["ms_to_idx"] = np.minimum(rows, count * turns).astype("u8")
        file["t_offset"] = offset
    return count * turns


if __name__ == "__main__":
    main()
