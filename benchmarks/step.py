"""Where the time of a whole training step goes.

python benchmarks/step.py [--method evsplat|paper] [--size PX] [--human N] [--scene N] [--renders T]
python benchmarks/step.py --capture FOLDER

Each part's forward time is that of its calls, its backward time that of the gradient nodes that
its forward pass made; the stages of `render` are timed inside the native module. "rest" is what no
part explains: Python, the loop and what lies between the parts. All steps draw one frame, one with
the most renders, so that they do the same work. Without a capture it is the demo's, stretched to
``--size``, with so many Gaussians; a capture is taken as it is. The limit is the time of the
networks' matrix products at the core's measured multiply-add peak. The last line is JSON with a
unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import dataclasses
import json
import resource
import shutil
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import torch
from PIL import Image
from rasterize import peak_flops
from torch import Tensor

from evsplat import _native
from evsplat.capture import Frame, load_capture
from evsplat.gaussians import GaussianSet
from evsplat.methods import TRAINABLE
from evsplat.models import drawing
from evsplat.models.discs import DiscModel, shadow_grids
from evsplat.models.discs import model as discs_model
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.paper import model as paper_model
from evsplat.objectives import event_windows, exposure
from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event_windows import EventWindows
from evsplat.pictures import CodedPictures
from evsplat.render import native as native_backend
from evsplat.shipped import demo_capture
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

Times = dict[str, float]
"""By part of a step."""


def main() -> None:
    """Print the table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", choices=("evsplat", "paper"), default="evsplat")
    parser.add_argument("--capture", type=Path, help="in place of the demo, as it is")
    parser.add_argument("--size", type=int, default=512, help="image side, px")
    parser.add_argument("--human", type=int, default=20_000)
    parser.add_argument("--scene", type=int, default=30_000)
    parser.add_argument(
        "--renders",
        type=int,
        help="of paper: times per step, 2 by default; of evsplat: the most in an exposure",
    )
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    folder = tempfile.TemporaryDirectory()
    capture = arguments.capture or resized_demo(arguments.size, Path(folder.name))
    human, scene = (None, None) if arguments.capture else (arguments.human, arguments.scene)
    trainer = build_on(capture, human, scene, arguments.renders, method=arguments.method)
    draw_one_frame(trainer)
    for _ in range(5):
        trainer.step()

    steps = [_timed(trainer.step) for _ in range(arguments.steps)]
    median, best = 1e3 * statistics.median(steps), 1e3 * min(steps)
    renders, gflop = work(trainer, 3)
    peak = peak_flops() / 1e9 * arguments.threads
    limit = 1e3 * gflop / peak
    forward, backward, stages = measure(trainer, arguments.steps)
    counts = trainer.counts()
    print(
        f"{arguments.method}: step {median:.1f} ms (best {best:.1f}): {image_px(trainer)} px, "
        f"{counts['human']} person and {counts['scene']} scene Gaussians, {renders:.1f} renders, "
        f"{arguments.threads} thread(s)"
    )
    print(f"  {'part':22s} {'forward':>8s} {'backward':>8s} ms   share")
    both = {part: (forward.get(part, 0.0), backward.get(part, 0.0)) for part in forward | backward}
    for part, times in sorted(both.items(), key=lambda item: -sum(item[1])):
        share = 100 * sum(times) / median
        print(f"  {part:22s} {times[0]:8.2f} {times[1]:8.2f}    {share:5.1f} %")
    rest = median - sum(map(sum, both.values()))
    print(f"  {'rest':22s} {rest:17.2f}    {100 * rest / median:5.1f} %")
    print("  inside render: " + ", ".join(f"{k} {v:.2f} ms" for k, v in stages.items()))
    print(f"  matrix products {gflop:.1f} GFLOP: {limit:.1f} ms at {peak:.0f} GFLOP/s")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    results: dict[str, float | str] = {
        "method": arguments.method,
        "image_px": image_px(trainer),
        "human": counts["human"],
        "scene": counts["scene"],
        "renders": round(renders, 1),
        "threads": arguments.threads,
        "step_median_ms": round(median, 2),
        "step_best_ms": round(best, 2),
        "products_gflop": round(gflop, 2),
        "products_limit_percent": round(100 * limit / median, 1),
        "peak_rss_mb": round(peak_mb),
    }
    for label, parts in (("forward", forward), ("backward", backward), ("render", stages)):
        for part, value in parts.items():
            results[f"{label}_{part.replace(',', '').replace(' ', '_')}_ms"] = round(value, 3)
    print(json.dumps(results))


def build_on(
    path: Path,
    human: int | None,
    scene: int | None,
    renders: int | None,
    *,
    method: str = "paper",
    device: str = "cpu",
) -> Trainer:
    """A training in the middle of its schedule, with everything switched on."""
    chosen = TRAINABLE[method]
    config = chosen.config()
    config = dataclasses.replace(config, human=dataclasses.replace(config.human, count=human))
    if human is not None:
        densify = dataclasses.replace(config.densify, max_human=human)
        config = dataclasses.replace(config, densify=densify)
    if method == "evsplat" and renders is not None:
        config = dataclasses.replace(config, most_renders=renders)
    capture = load_capture(path).for_training(config.policy)
    composition = chosen.build(config, capture, 0, device=device, purpose="resume")
    if method == "paper" and renders is not None:
        composition.objectives.append(MoreTimes(renders))
        composition.weights["more_times"] = 1e-6
    if scene is not None:
        model: Any = composition.model
        model.gaussians = with_scene_count(model.gaussians, scene)
    return Trainer(composition, capture, Clock(100_000, fraction=0.4))


def image_px(trainer: Trainer) -> int:
    """Side of the pictures, the longer one."""
    camera = trainer.capture.camera(trainer.capture.train_frames[0])
    return max(camera.width, camera.height)


def draw_one_frame(trainer: Trainer) -> None:
    """Let every step draw the frame in the middle of those with the most renders."""
    nominal = trainer.clock.nominal
    generator = trainer.composition.generator
    state = generator.get_state()
    counts = {
        frame: len({t for o in trainer.composition.objectives for t in o.times(frame, nominal)})
        for frame in trainer.capture.train_frames
    }
    generator.set_state(state)
    most = [frame for frame, count in counts.items() if count == max(counts.values())]
    frame = most[len(most) // 2]
    changed: Any = trainer
    changed._draw_frame = lambda: frame


def resized_demo(size: int, folder: Path) -> Path:
    """The demo capture with pictures and events stretched to ``size`` pixels."""
    shutil.copytree(demo_capture(), folder, dirs_exist_ok=True)
    metadata = json.loads((folder / "capture.json").read_text())
    factor = size / metadata["cameras"]["main"]["width"]
    metadata["cameras"] = {"main": metadata["cameras"]["main"]}
    metadata["novel_views"] = []
    for plane in (metadata["cameras"]["main"], metadata["events"]):
        plane["width"] = plane["height"] = size
    K = np.array(metadata["cameras"]["main"]["K"])
    K[:2] *= factor
    metadata["cameras"]["main"]["K"] = K.tolist()
    for path in folder.glob("[ims]*/*.webp"):
        Image.open(path).resize((size, size)).save(path, lossless=True)
    with h5py.File(folder / "events.h5", "r+") as events:
        for axis in ("x", "y"):
            events["events"][axis][:] = (events["events"][axis][:] * factor).astype(np.uint16)
    (folder / "capture.json").write_text(json.dumps(metadata))
    return folder


def with_scene_count(gaussians: GaussianSet, count: int) -> GaussianSet:
    """As many scene Gaussians as asked: some of them, or some twice."""
    generator = torch.Generator().manual_seed(0)
    human, scene = gaussians.human, gaussians.scene_count
    rows = (
        gaussians.human_count
        + torch.cat(
            [torch.randperm(scene, generator=generator) for _ in range(-(-count // scene))]
        )[:count]
    )
    values = {name: getattr(gaussians, name).detach() for name in gaussians.attributes}
    return GaussianSet(
        {name: value[human] for name, value in values.items()},
        {name: value[rows] for name, value in values.items()},
    )


class MoreTimes(Objective):
    """Asks for times around a frame until there are enough, with a small loss on each."""

    def __init__(self, renders: int) -> None:
        self.renders = renders

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """Beside the frame's own and its neighbour's."""
        return [frame.mid_us + 1_000 * k for k in range(1, self.renders - 1)]

    def loss(self, step: Step) -> dict[str, Tensor]:
        """Mean of all that was drawn."""
        return {
            "more_times": torch.stack(
                [picture.movedim(-1, 0).mean() for picture in step.rgb]
            ).mean()
        }


def work(trainer: Trainer, steps: int) -> tuple[float, float]:
    """Means per step: rendered times, and the networks' matrix products in GFLOP, both ways."""
    flop: list[float] = []
    times: list[int] = []
    model: Any = trainer.model
    draw = model.training_drawing

    def counted(times_us: Sequence[int], *rest: Any) -> Any:
        times.append(len(times_us))
        return draw(times_us, *rest)

    def count(mlp: PointMLP, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        each = mlp.both_weight.numel() + sum(weight.numel() for weight in mlp.weights)
        products = len(inputs[0]) * mlp.point_weight.numel() + output[..., 0].numel() * each
        # The product, its gradient to the inputs and that to the weights, two operations each.
        flop.append(6.0 * products)

    networks = [module for module in model.modules() if isinstance(module, PointMLP)]
    hooks = [network.register_forward_hook(count) for network in networks]
    model.training_drawing = counted
    for _ in range(steps):
        trainer.step()
    del model.training_drawing
    for hook in hooks:
        hook.remove()
    return sum(times) / steps, sum(flop) / steps / 1e9


def measure(trainer: Trainer, steps: int) -> tuple[Times, Times, Times]:
    """Milliseconds per step: forward and backward by part, and the stages of render."""
    watch = Stopwatch()
    watch_parts(watch, trainer)
    jobs: list[Any] = []

    def keep(*inputs: Any) -> Any:
        jobs.append(_native.Render(*inputs))
        return jobs[-1]

    native_backend.native = SimpleNamespace(Render=keep, rows_in_view=_native.rows_in_view)
    for _ in range(steps):
        trainer.step()
        watch.nodes.clear()
    native_backend.native = _native
    threads = torch.get_num_threads()
    stages: Times = defaultdict(float)
    for job in jobs:
        for stage, seconds in job.seconds.items():
            stages[stage] += 1e3 * seconds / threads / steps

    def per_step(seconds: Times) -> Times:
        return {part: 1e3 * value / steps for part, value in seconds.items()}

    return per_step(watch.forward), per_step(watch.backward), stages


def watch_parts(watch: "Stopwatch", trainer: Trainer) -> None:
    """Let it look at all parts of a step."""
    model: Any = trainer.model
    watch.calls(model, "pose", "body pose")
    if isinstance(model, DiscModel):
        watch.calls(model.shade, "forward", "shade by the pose")
        watch.calls(model.surface, "normals", "nearest surface")
        watch.calls(model.surface, "weights", "nearest surface")
        watch.calls(discs_model, "skin_with_linear", "blend skinning")
        watch.calls(model, "_light", "light")
        watch.calls(model.lamps, "places", "lamps")
        watch.calls(model.shadow, "place", "casters")
        watch.calls(shadow_grids, "shadow_on_scene", "shadow on the scene")
        watch.calls(shadow_grids, "light_on_body", "shadow on the person")
        watch.calls(model.shadow, "both", "both shadows, rest")
        watch.calls(model.places, "of", "places of the scene")
        watch.calls(drawing, "_enlarge", "shadow enlarged")
    else:
        watch.calls(model.deformation.pose_encoder, "forward", "pose encoder")
        watch.calls(model.deformation.network.encoding, "forward", "position encoding")
        watch.calls(model.deformation.network, "forward", "non-rigid network")
        watch.calls(model.skinning, "forward", "skinning network")
        watch.calls(paper_model, "skin_with_linear", "blend skinning")
        watch.calls(model.human_colour, "forward", "human colour")
        watch.calls(model.scene_colour, "forward", "scene colour")
    watch.calls(model, "_layers", "posing, rest")
    watch.calls(drawing, "render", "render")
    watch.calls(model, "training_drawing", "drawing, rest")
    watch.calls(CodedPictures, "mean_light", "mean light")
    watch.calls(exposure, "encode", "encode")
    watch.calls(exposure, "l1_and_ssim", "L1 and SSIM")
    for objective in trainer.composition.objectives:
        watch.calls(objective, "loss", f"loss {type(objective).__name__}")
        if isinstance(objective, EventWindows):
            watch.calls(objective.events, "between", "events read")
            watch.calls(event_windows, "window_counts", "events counted")
            watch.calls(CodedPictures, "log_luminance", "log luminance")
    watch.calls(trainer, "_count", "densification")
    watch.calls(trainer.optimiser, "step", "optimiser")
    watch.calls(trainer.optimiser, "finite", "finite check")


class Stopwatch:
    """Time of the parts' calls, without the calls of parts inside, and of their gradients.

    ``clock`` may count something else than seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self.forward: Times = defaultdict(float)
        self.backward: Times = defaultdict(float)
        self.nodes: dict[Any, str] = {}
        self._inner = [0.0]

    def calls(self, owner: Any, name: str, part: str) -> None:
        """Watch all calls of ``owner.name``."""
        call = getattr(owner, name)

        def outer(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            start = self.clock()
            result = call(*args, **kwargs)
            own = self.clock() - start
            self.forward[part] += own - self._inner.pop()
            self._claim(result, part)
            # What is spent on watching belongs to nobody.
            self._inner[-1] += self.clock() - start
            return result

        setattr(owner, name, outer)

    def _claim(self, result: Any, part: str) -> None:
        """Time the gradient of every operation that led to ``result`` and has no part yet."""
        waiting = [tensor.grad_fn for tensor in _tensors(result)]
        while waiting:
            node = waiting.pop()
            if node is None or node in self.nodes or node.name().endswith("AccumulateGrad"):
                continue
            self.nodes[node] = part
            since = [0.0]

            def before(_: Any, since: list[float] = since) -> None:
                since[0] = self.clock()

            def after(_: Any, __: Any, since: list[float] = since) -> None:
                self.backward[part] += self.clock() - since[0]

            node.register_prehook(before)
            node.register_hook(after)
            waiting += [next_node for next_node, _ in node.next_functions]


def _tensors(value: Any) -> Iterable[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif dataclasses.is_dataclass(value):
        for inner in vars(value).values():
            yield from _tensors(inner)
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _tensors(inner)


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
