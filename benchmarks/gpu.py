"""All of evsplat on an NVIDIA GPU in one call of under eight minutes.

python benchmarks/gpu.py [--sizes PX ...] [--minutes M] [--method NAME] [--device cuda|cpu]

Building gsplat's kernels (once), agreement of the rasteriser and of a training step with native
ones, the rasteriser's time, and for each size of the demo capture a training step with its
launches, a whole training with its quality, and frames per second of drawing; after each part the
peak of GPU memory. A part that fails is told and the rest goes on. With --device cpu the same parts
run with the native backend, to try this file where there is no GPU. The last line is JSON with a
unit in each key; without a GPU the exit status is 2.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from rasterize import Scene, make_scene, person_over_scene, with_gradient
from step import build_on, draw_one_frame, resized_demo
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture import Capture, Frame
from evsplat.cuda_support import needs, what_is_missing
from evsplat.render import Splats, cuda, render
from evsplat.similarity import psnr
from evsplat.training import load_run, train
from evsplat.training.reconstruction import GaussianReconstruction

Results = dict[str, float | str]
BOUNDS = {"image": 1e-4, "gradient": 1e-3, "loss": 1e-3}


def main() -> None:
    """Run the parts and print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="of pictures, px")
    parser.add_argument("--minutes", type=float, default=2.0, help="of each training, at most")
    parser.add_argument("--method", default="evsplat")
    parser.add_argument("--gaussians", type=int, default=50_000, help="of the rasteriser's scene")
    parser.add_argument("--repeats", type=int, default=20, help="of what is timed")
    arguments = parser.parse_args()
    missing = what_is_missing()
    if arguments.device == "cuda" and missing is not None:
        print(f"benchmarks/gpu.py: {missing}", file=sys.stderr)
        sys.exit(2)
    if arguments.device == "cuda":
        for need in needs():
            print(f"{need.name}: {need.detail}")
    bench = Bench(arguments.device, arguments.repeats)
    bench.part("build", bench.build)
    bench.part("agreement", partial(bench.agreement, arguments.gaussians))
    bench.part("rasteriser", partial(bench.rasteriser, arguments.gaussians))
    method, minutes = arguments.method, arguments.minutes
    for size in arguments.sizes:
        with tempfile.TemporaryDirectory() as folder:
            capture, run = resized_demo(size, Path(folder) / "capture"), Path(folder) / "run"
            bench.part(f"same_step_{size}", partial(bench.same_step, capture, method))
            bench.part(f"step_{size}", partial(bench.step, capture, method))
            bench.part(f"train_{size}", partial(bench.train, capture, run, method, minutes))
            bench.part(f"draw_{size}", partial(bench.draw, run))
    print(json.dumps(bench.results))


class Bench:
    """Parts and what they measured."""

    def __init__(self, device: str, repeats: int) -> None:
        self.device, self.repeats, self.size_px = device, repeats, 512
        self.cuda = device == "cuda"
        name = torch.cuda.get_device_name() if self.cuda else "cpu"
        self.results: Results = {"device": name, "torch": torch.__version__}

    def part(self, name: str, run: Callable[[], Results]) -> None:
        """Run one part, print what it measured or why it failed."""
        if self.cuda:
            torch.cuda.reset_peak_memory_stats()
        start = time.perf_counter()
        try:
            found = run()
        except Exception as error:
            traceback.print_exc()
            found = {"error": f"{type(error).__name__}: {error}"[:300]}
        found["seconds"] = round(time.perf_counter() - start, 1)
        if self.cuda:
            found["peak_memory_mb"] = round(torch.cuda.max_memory_allocated() / 1e6)
        self.results |= {f"{name}_{key}": value for key, value in found.items()}
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in found.items()), flush=True)

    def build(self) -> Results:
        """Load gsplat, which builds its kernels if they are not there yet."""
        if self.cuda:
            cuda.load()
            self._wait()
        return {}

    def agreement(self, count: int) -> Results:
        """Largest difference of pictures, and relative L2 of each gradient, beside native."""
        if not self.cuda:
            return {"within_bounds": "not measured: native on both sides"}
        scene = make_scene(self.size_px, count, 4)
        (image, alpha, gradients) = self._drawn(scene, self.device)
        (native_image, native_alpha, native_gradients) = self._drawn(scene, "cpu")
        error = (image - native_image).abs()
        found: Results = {
            "image_max": float(error.max()),
            "image_share_above_1e-4": float((error > BOUNDS["image"]).float().mean()),
            "alpha_max": float((alpha - native_alpha).abs().max()),
        }
        worst = 0.0
        for name, expected in native_gradients.items():
            relative = float((gradients[name] - expected).norm() / expected.norm())
            found[f"gradient_{name}_relative"] = relative
            worst = max(worst, relative)
        good = float(error.max()) < BOUNDS["image"] and worst < BOUNDS["gradient"]
        return found | {"within_bounds": str(good)}

    def rasteriser(self, count: int) -> Results:
        """Forward, and forward with backward; one picture, and five of a person over a scene."""
        scene = make_scene(self.size_px, count, 4)
        splats, camera = _to(scene.splats, self.device), self._camera(scene)
        leaves = with_gradient(splats)
        upstream = scene.image_grad.to(self.device)

        def forward() -> None:
            with torch.no_grad():
                render(splats, camera)

        def both() -> None:
            (render(leaves, camera).image * upstream).sum().backward()

        layers = person_over_scene(self.size_px, 4, times=5)
        moving = with_gradient(_to(layers.moving, self.device))
        static = with_gradient(_to(layers.static, self.device))

        def five() -> None:
            out = render(moving, camera, static=static)
            (out.image * upstream).sum().backward()

        return {
            "forward_ms": self._timed(forward),
            "both_ms": self._timed(both),
            "five_times_both_ms": self._timed(five),
        }

    def same_step(self, capture: Path, method: str) -> Results:
        """The first step's losses beside those of native: relative difference of each."""
        if not self.cuda:
            return {"within_bounds": "not measured: native on both sides"}
        reports = []
        for device in (self.device, "cpu"):
            trainer = build_on(capture, None, None, None, method=method, device=device)
            draw_one_frame(trainer)
            reports.append(trainer.step())
        ours, native = reports
        assert ours is not None and native is not None
        found = {
            f"{name}_relative": abs(ours.terms[name] - value) / max(abs(value), 1e-12)
            for name, value in native.terms.items()
        }
        return found | {"within_bounds": str(max(found.values()) < BOUNDS["loss"])}

    def step(self, capture: Path, method: str) -> Results:
        """A training step in the middle of the schedule, with the most renders; its launches."""
        trainer = build_on(capture, None, None, None, method=method, device=self.device)
        draw_one_frame(trainer)
        found: Results = {"ms": self._timed(trainer.step, warm_up=10)}
        found |= {f"{part}_gaussians": count for part, count in trainer.counts().items()}
        if self.cuda:
            activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
            with torch.profiler.profile(activities=activities) as profile:
                trainer.step()
                self._wait()
            names = ("cudaLaunchKernel", "cuLaunchKernel", "cudaMemcpyAsync", "cudaMemsetAsync")
            counts = {event.key: event.count for event in profile.key_averages()}
            found |= {f"{name}_calls": counts.get(name, 0) for name in names}
        return found

    def train(self, capture: Path, run: Path, method: str, minutes: float) -> Results:
        """Whole training with its schedule fitted into the time, as a user calls it."""
        start = time.perf_counter()
        train(capture, method=method, out=run, device=self.device, max_minutes=minutes)
        seconds = time.perf_counter() - start
        loaded = load_run(run, device=self.device)
        with torch.no_grad():
            values = [
                float(psnr(_drawn_frame(loaded.reconstruction, loaded.capture, frame), sharp))
                for frame in loaded.capture.test_frames
                if frame.sharp is not None
                for sharp in [loaded.capture.sharp(frame)]
            ]
        return {
            "wall_s": round(seconds, 1),
            "steps": loaded.iteration,
            "steps_per_s": round(loaded.iteration / max(loaded.train_seconds, 1e-9), 2),
            "test_psnr_db": round(statistics.mean(values), 3),
            **{f"{part}_gaussians": count for part, count in loaded.gaussians.items()},
        }

    def draw(self, run: Path) -> Results:
        """Frames per second of the trained model: pose, networks and rasteriser, one at a time."""
        loaded = load_run(run, device=self.device)
        capture, model = loaded.capture, loaded.reconstruction
        mids = [frame.mid_us for frame in capture.frames]
        camera = capture.camera(capture.frames[0])
        instants = torch.linspace(mids[0], mids[-1], 60).long().tolist()
        for time_us in instants[:5]:
            model.render(camera, [time_us])
        self._wait()
        start = time.perf_counter()
        for time_us in instants:
            model.render(camera, [time_us])
        self._wait()
        seconds = time.perf_counter() - start
        return {"frames_per_s": round(len(instants) / seconds, 1)}

    def _camera(self, scene: Scene) -> Camera:
        pose = scene.camera.world_to_camera.to(self.device)
        return replace(scene.camera, world_to_camera=pose)

    def _drawn(self, scene: Scene, device: str) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Image, alpha and gradients on the CPU, of a render on ``device``."""
        leaves = {
            name: value.clone().requires_grad_()
            for name, value in vars(_to(scene.splats, device)).items()
            if value is not None
        }
        pose = scene.camera.world_to_camera.to(device, copy=True).requires_grad_()
        camera = replace(scene.camera, world_to_camera=pose)
        out = render(Splats(**leaves), camera)
        wanted = leaves | {"pose": pose}
        upstream = [scene.image_grad.to(device), scene.alpha_grad.to(device)]
        found = torch.autograd.grad([out.image, out.alpha], list(wanted.values()), upstream)
        gradients = {name: value.cpu() for name, value in zip(wanted, found, strict=True)}
        return out.image.detach().cpu(), out.alpha.detach().cpu(), gradients

    def _timed(self, run: Callable[[], object], warm_up: int = 3) -> float:
        """Median milliseconds of a call until the device is done."""
        times = []
        for i in range(warm_up + self.repeats):
            self._wait()
            start = time.perf_counter()
            run()
            self._wait()
            if i >= warm_up:
                times.append(1e3 * (time.perf_counter() - start))
        return round(statistics.median(times), 3)

    def _wait(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()


def _drawn_frame(model: GaussianReconstruction, capture: Capture, frame: Frame) -> Tensor:
    return model.render(capture.camera(frame), [frame.mid_us]).rgb[0]


def _to(splats: Splats, device: str) -> Splats:
    values = vars(splats).items()
    return replace(splats, **{name: v.to(device) for name, v in values if v is not None})


if __name__ == "__main__":
    main()
