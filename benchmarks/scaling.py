"""How time and memory grow: with Gaussians, pixels, times per render, and length of the recording.

python benchmarks/scaling.py [--threads T] [--quick]

Each point runs in a process of its own, so that its peak memory is its own (Python and PyTorch are
about 300 MB of it). Renders are forward and backward to every input; the last curve trains method
`paper` on the demo capture repeated in time. The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import torch
from rasterize import make_scene, person_over_scene, timed, with_gradient
from step import build_on

from evsplat.render import Splats, render
from evsplat.shipped import demo_capture

CURVES = {
    "gaussians": (10_000, 30_000, 100_000, 300_000, 1_000_000),
    "side_px": (256, 512, 1024, 1440),
    "times": (1, 2, 4, 8, 16),
    "recording": (1, 4, 16),
}
FIXED = {
    "gaussians": "512 x 512",
    "side_px": "50,000 Gaussians; 1440 x 1440 has the pixels of 1080p",
    "times": "512 x 512, 20,000 moving and 30,000 static Gaussians",
    "recording": "256 x 256, multiples of 31 frames and 2.5 s; a training step",
}


def main() -> None:
    """Run every point, or with ``--point`` that one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--quick", action="store_true", help="the first two points of each curve")
    parser.add_argument("--point", nargs=2, metavar=("CURVE", "VALUE"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.point:
        curve, value = arguments.point
        milliseconds = measure(curve, int(value))
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        print(json.dumps({"median_ms": round(milliseconds, 1), "peak_rss_mb": round(peak_mb)}))
        return
    results: dict[str, float] = {"threads": arguments.threads}
    for curve, values in CURVES.items():
        print(f"{curve} ({FIXED[curve]})")
        for value in values[:2] if arguments.quick else values:
            command = [sys.executable, __file__, "--threads", str(arguments.threads)]
            done = subprocess.run(
                [*command, "--point", curve, str(value)],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            point = json.loads(done.stdout.splitlines()[-1])
            print(f"  {value:9,d}  {point['median_ms']:8.1f} ms  {point['peak_rss_mb']:6,d} MB")
            results |= {f"{curve}_{value}_{key}": number for key, number in point.items()}
    print(json.dumps(results))


def measure(curve: str, value: int) -> float:
    """Median milliseconds of one point."""
    if curve == "recording":
        with tempfile.TemporaryDirectory() as folder:
            trainer = build_on(repeated_demo(value, Path(folder)), None, None, 2)
            for frame in trainer.capture.train_frames:
                trainer.capture.image(frame)
            return timed(trainer.step, 40).median
    static: Splats | None = None
    if curve == "times":
        layers = person_over_scene(512, 4, value)
        camera, grad = layers.camera, layers.image_grad
        moving, static = with_gradient(layers.moving), with_gradient(layers.static)
    else:
        size_px, count = (512, value) if curve == "gaussians" else (value, 50_000)
        scene = make_scene(size_px, count, 4)
        camera, grad, moving = scene.camera, scene.image_grad, with_gradient(scene.splats)
    leaves = [
        value
        for layer in (moving, static)
        if layer is not None
        for value in vars(layer).values()
        if value is not None
    ]
    grad = grad.expand(len(moving.means), -1, -1, -1)

    def both() -> None:
        out = render(moving, camera, static=static)
        torch.autograd.grad(out.image, leaves, grad)

    return timed(both, 7).median


def repeated_demo(times: int, folder: Path) -> Path:
    """The demo capture ``times`` in a row: frames, poses and events go on where they ended."""
    shutil.copytree(demo_capture(), folder, dirs_exist_ok=True)
    metadata = json.loads((folder / "capture.json").read_text())
    frames, metadata["novel_views"] = metadata["frames"], []
    body = dict(np.load(folder / "body.npz"))
    period = int(2 * body["times_us"][-1] - body["times_us"][-2] - body["times_us"][0])
    metadata["frames"] = [
        {
            **frame,
            "name": f"{n * len(frames) + i:05d}",
            "exposure_us": [at + n * period for at in frame["exposure_us"]],
        }
        for n in range(times)
        for i, frame in enumerate(frames)
    ]
    body["times_us"] = np.concatenate([body["times_us"] + n * period for n in range(times)])
    for name in ("poses", "transl"):
        body[name] = np.concatenate([body[name]] * times)
    np.savez(folder / "body.npz", **body)
    with h5py.File(folder / "events.h5", "r") as file:
        events = {name: file["events"][name][:] for name in "txyp"}
        offset = int(file["t_offset"][()])
    inside = events["t"] < period
    starts = [events["t"][inside] + n * period for n in range(times)]
    (folder / "events.h5").unlink()
    with h5py.File(folder / "events.h5", "w") as file:
        t = np.concatenate(starts)
        file.create_dataset("events/t", data=t, chunks=True)
        for name in "xyp":
            data = np.concatenate([events[name][inside]] * times)
            file.create_dataset(f"events/{name}", data=data, chunks=True)
        file["ms_to_idx"] = np.searchsorted(t, 1000 * np.arange(t[-1] // 1000 + 2)).astype("u8")
        file["t_offset"] = offset
    (folder / "capture.json").write_text(json.dumps(metadata))
    return folder


if __name__ == "__main__":
    main()
