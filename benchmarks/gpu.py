"""All of evsplat on an NVIDIA GPU in one call of under eight minutes.

python benchmarks/gpu.py [--minutes M] [--device cuda|cpu] [--size PX]

Building gsplat's kernels (once), agreement of the rasteriser with the native one, its time, a
training step, a whole training of the demo capture at --size, its quality, frames per second of
drawing it, memory. A part that fails is told and the rest
goes on. With --device cpu the same parts run with the native backend, to try this file where there
is no GPU. The last line is JSON with a unit in each key; without a GPU the exit status is 2.
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
from pathlib import Path
from types import SimpleNamespace

import torch
from rasterize import Scene, make_scene, person_over_scene, with_gradient
from step import build_on, resized_demo
from torch import Tensor

from evsplat.capture import Capture
from evsplat.cuda_support import needs, what_is_missing
from evsplat.render import Splats, cuda, render
from evsplat.similarity import psnr
from evsplat.training import load_run, train

Results = dict[str, float | str]
BOUNDS = {"image": 1e-4, "gradient": 1e-3}


def main() -> None:
    """Run the parts and print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--size", type=int, default=512, help="image side of the capture, px")
    parser.add_argument("--minutes", type=float, default=2.0, help="of training")
    parser.add_argument("--method", default="paper")
    parser.add_argument("--gaussians", type=int, default=50_000, help="of the rasteriser's scene")
    arguments = parser.parse_args()
    missing = what_is_missing()
    if arguments.device == "cuda" and missing is not None:
        print(f"benchmarks/gpu.py: {missing}", file=sys.stderr)
        sys.exit(2)
    if arguments.device == "cuda":
        for need in needs():
            print(f"{need.name}: {need.detail}")
    bench = Bench(arguments.device, arguments.size)
    with tempfile.TemporaryDirectory() as folder:
        capture = resized_demo(arguments.size, Path(folder) / "capture")
        run = Path(folder) / "run"
        bench.part("build", bench.build)
        bench.part("agreement", lambda: bench.agreement(arguments.gaussians))
        bench.part("rasteriser", lambda: bench.rasteriser(arguments.gaussians))
        bench.part("step", lambda: bench.step(capture))
        bench.part("train", lambda: bench.train(capture, run, arguments.method, arguments.minutes))
        bench.part("draw", lambda: bench.draw(run))
    if bench.cuda:
        bench.results["peak_gpu_memory_mb"] = round(torch.cuda.max_memory_allocated() / 1e6)
        bench.results["reserved_gpu_memory_mb"] = round(torch.cuda.max_memory_reserved() / 1e6)
    print(json.dumps(bench.results))


class Bench:
    """Parts and what they measured."""

    def __init__(self, device: str, size_px: int) -> None:
        self.device, self.size_px = device, size_px
        self.cuda = device == "cuda"
        name = torch.cuda.get_device_name() if self.cuda else "cpu"
        self.results: Results = {"device": name, "torch": torch.__version__, "side_px": size_px}

    def part(self, name: str, run: Callable[[], Results]) -> None:
        """Run one part, print what it measured or why it failed."""
        start = time.perf_counter()
        try:
            found = run()
        except Exception as error:
            traceback.print_exc()
            found = {f"{name}_error": f"{type(error).__name__}: {error}"[:300]}
        found[f"{name}_seconds"] = round(time.perf_counter() - start, 1)
        self.results |= found
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
            return {"agreement_within_bounds": "not measured: native on both sides"}
        scene = make_scene(self.size_px, count, 4)
        (image, alpha, gradients) = self._drawn(scene, self.device)
        (native_image, native_alpha, native_gradients) = self._drawn(scene, "cpu")
        error = (image - native_image).abs()
        found: Results = {
            "agreement_image_max": float(error.max()),
            "agreement_image_share_above_1e-4": float((error > BOUNDS["image"]).float().mean()),
            "agreement_alpha_max": float((alpha - native_alpha).abs().max()),
        }
        worst = 0.0
        for name, expected in native_gradients.items():
            relative = float((gradients[name] - expected).norm() / expected.norm())
            found[f"agreement_gradient_{name}_relative"] = relative
            worst = max(worst, relative)
        good = float(error.max()) < BOUNDS["image"] and worst < BOUNDS["gradient"]
        return found | {"agreement_within_bounds": str(good)}

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
            "render_forward_ms": self._timed(forward),
            "render_both_ms": self._timed(both),
            "render_five_times_both_ms": self._timed(five),
        }

    def step(self, capture: Path) -> Results:
        """A training step of method `paper` with everything on, at two sizes."""
        found: Results = {}
        for name, human, scene, renders in (("2", 20_000, 30_000, 2), ("5", 20_000, 30_000, 5)):
            trainer = build_on(capture, human, scene, renders, device=self.device)
            found[f"step_{name}_renders_ms"] = self._timed(trainer.step, repeats=30, warm_up=10)
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
            "train_method": method,
            "train_wall_s": round(seconds, 1),
            "train_steps": loaded.iteration,
            "train_steps_per_s": round(loaded.iteration / max(loaded.train_seconds, 1e-9), 2),
            "train_test_psnr_db": round(statistics.mean(values), 3),
            **{f"train_{part}_gaussians": count for part, count in loaded.gaussians.items()},
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
        return {"draw_frames_per_s": round(len(instants) / seconds, 1)}

    def _camera(self, scene: Scene) -> SimpleNamespace:
        given = scene.camera
        pose = given.world_to_camera.to(self.device)
        return SimpleNamespace(
            width=given.width, height=given.height, K=given.K, world_to_camera=pose
        )

    def _drawn(self, scene: Scene, device: str) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Image, alpha and gradients on the CPU, of a render on ``device``."""
        leaves = {
            name: value.clone().requires_grad_()
            for name, value in vars(_to(scene.splats, device)).items()
            if value is not None
        }
        pose = scene.camera.world_to_camera.to(device, copy=True).requires_grad_()
        camera = SimpleNamespace(
            width=scene.camera.width, height=scene.camera.height, K=scene.camera.K,
            world_to_camera=pose,
        )  # fmt: skip
        out = render(Splats(**leaves), camera)
        wanted = leaves | {"pose": pose}
        upstream = [scene.image_grad.to(device), scene.alpha_grad.to(device)]
        found = torch.autograd.grad([out.image, out.alpha], list(wanted.values()), upstream)
        gradients = {name: value.cpu() for name, value in zip(wanted, found, strict=True)}
        return out.image.detach().cpu(), out.alpha.detach().cpu(), gradients

    def _timed(self, run: Callable[[], object], repeats: int = 20, warm_up: int = 3) -> float:
        """Median milliseconds of a call until the device is done."""
        times = []
        for i in range(warm_up + repeats):
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


def _drawn_frame(model: object, capture: Capture, frame: object) -> Tensor:
    return model.render(capture.camera(frame), [frame.mid_us]).rgb[0]  # type: ignore[attr-defined]


def _to(splats: Splats, device: str) -> Splats:
    return Splats(*(None if value is None else value.to(device) for value in vars(splats).values()))


if __name__ == "__main__":
    main()
