"""Where the time of a whole training step goes, method `paper`.

python benchmarks/step.py [CAPTURE] [--human N] [--threads T] [--steps S]

Forward times are those of the named parts; "backward" is the whole of it, with the native kernels
inside listed below. The limit is the time of the step's matrix products at the core's measured
multiply-add peak: the share says how much of the step is arithmetic that cannot be avoided. The
last line is JSON with a unit in each key.
"""

import argparse
import dataclasses
import json
import statistics
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from evsplat import _native
from evsplat.capture import load_capture
from evsplat.cli.demo import demo_capture
from evsplat.deform import human_scene
from evsplat.methods import PaperConfig, compose
from evsplat.training import trainer as trainer_module
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer


def main() -> None:
    """Print the table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", nargs="?", type=Path, default=None)
    parser.add_argument("--human", type=int, default=10_000)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    trainer = _trainer(arguments.capture or demo_capture(), arguments.human)
    for _ in range(5):
        trainer.step()

    steps = [_timed(trainer.step) for _ in range(arguments.steps)]
    median, best = 1e3 * statistics.median(steps), 1e3 * min(steps)
    gflop = _products(trainer) / 1e9
    peak = _peak() * arguments.threads
    parts = _parts(trainer, arguments.steps)
    print(f"step {median:.1f} ms (best {best:.1f}), {arguments.threads} thread(s)")
    for name, seconds in parts.most_common():
        print(f"  {name:28s} {1e3 * seconds:7.2f} ms  {1e5 * seconds / median:5.1f} %")
    limit = 1e3 * gflop / peak
    print(f"matrix products {gflop:.1f} GFLOP: {limit:.1f} ms at {peak:.0f} GFLOP/s")
    results = {
        "human": arguments.human,
        "scene": trainer.counts()["scene"],
        "threads": arguments.threads,
        "step_median_ms": round(median, 2),
        "step_best_ms": round(best, 2),
        "products_gflop": round(gflop, 2),
        "products_limit_percent": round(100 * limit / median, 1),
    }
    for name, seconds in parts.items():
        results[f"{name.replace(' ', '_')}_ms"] = round(1e3 * seconds, 3)
    print(json.dumps(results))


def _trainer(path: Path, human: int) -> Trainer:
    """A training in the middle of its schedule, where everything is switched on."""
    config = PaperConfig()
    config = dataclasses.replace(
        config,
        human=dataclasses.replace(config.human, count=human),
        densify_human=dataclasses.replace(config.densify_human, max_count=human),
    )
    capture = load_capture(path)
    composition = compose(config, capture, 0, fit=False)
    return Trainer(composition, capture, Clock(100_000, fraction=0.4))


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _parts(trainer: Trainer, steps: int) -> Counter[str]:
    """Seconds per step of each part, forward by wrapping and backward by the profiler."""
    seconds: Counter[str] = Counter()

    def watch(owner: Any, name: str, label: str) -> None:
        inner = getattr(owner, name)

        def outer(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = inner(*args, **kwargs)
            seconds[label] += (time.perf_counter() - start) / steps
            return result

        setattr(owner, name, outer)

    model = trainer.model
    watch(model, "pose", "body pose")
    watch(model.pose_encoder, "forward", "pose encoder")
    watch(model.non_rigid, "forward", "non-rigid network")
    watch(model.skinning, "forward", "skinning network")
    watch(human_scene, "skin", "blend skinning")
    watch(model.human_colour, "forward", "human colour")
    watch(model.scene_colour, "forward", "scene colour")
    watch(trainer_module, "render", "render")
    for objective in trainer.composition.objectives:
        watch(objective, "loss", f"objective {type(objective).__name__}")
    watch(torch.Tensor, "backward", "backward")
    watch(trainer.optimiser, "step", "optimiser")
    for _ in range(steps):
        trainer.step()
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(steps):
            trainer.step()
    for event in profiler.key_averages():
        if event.key in ("_NativeMLPBackward", "_RasterizeBackward", "_NativeSsimBackward"):
            seconds[f"of it {event.key.strip('_')}"] = event.cpu_time_total / 1e6 / steps
    return seconds


def _products(trainer: Trainer) -> float:
    """Floating-point operations of the networks' matrix products, forward and backward, 2 times."""
    model, counts = trainer.model, trainer.counts()
    human, scene = counts["human"], counts["scene"]

    def later(mlp: Any) -> int:
        return sum(weight.numel() for weight in mlp.weights)

    non_rigid, skinning = model.non_rigid.mlp, model.skinning.mlp
    colour, backdrop = model.human_colour.mlp, model.scene_colour.mlp
    rows = human * (non_rigid.point_weight.numel() + 2 * later(non_rigid))
    rows += human * (skinning.point_weight.numel() + later(skinning))
    rows += human * (colour.point_weight.numel() + 2 * (colour.both_weight.numel() + later(colour)))
    rows += scene * (backdrop.point_weight.numel() + later(backdrop))
    return 6.0 * rows


def _peak() -> float:
    """GFLOP/s of independent multiply-adds on one core."""
    _native.multiply_add(10_000_000)
    return max(flops / seconds / 1e9 for flops, seconds in (_rate() for _ in range(5)))


def _rate() -> tuple[float, float]:
    start = time.perf_counter()
    flops = _native.multiply_add(20_000_000)
    return flops, time.perf_counter() - start


if __name__ == "__main__":
    main()
