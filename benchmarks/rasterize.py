"""Speed of the native rasteriser on the random scene of many small Gaussians.

Prints forward and forward+backward times on 1 and 2 threads, the stages on one thread, the share of
one core's peak, what it is where memory and short runs do not count, the ratio to the torch
reference on a smaller scene, what five times of one camera cost, and memory; with ``--run`` also
what five times of a trained run's exposure cost.
The last line is one JSON object with the same numbers.
"""

import evsplat  # before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import math
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from evsplat import _native
from evsplat.camera import Camera
from evsplat.render import LOW_PASS, Splats, render
from evsplat.render.splats import join

# Floating-point operations per lane of a patch step, a multiply-add as two: constant, per channel.
# Counted in native/kernels.cpp; comparisons, selections and integer operations are left out. With
# fewer than 16 lanes (native/narrow.h) a step has three less, which shares of the peak leave in.
FLOP_PER_LANE = {"forward": (26, 2), "backward": (41, 4)}


@dataclass(frozen=True)
class Scene:
    """One frame's Gaussians and the gradient of its picture."""

    splats: Splats
    camera: Camera
    image_grad: torch.Tensor
    alpha_grad: torch.Tensor


def make_scene(size_px: int, count: int, channels: int, seed: int = 0) -> Scene:
    """Gaussians all over the image and 5 % around it; opacity 0.1..0.9.

    Three deviations of the longest axis are 2..8 px, log-uniform; it is 1..5 times the others.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    focal_px = 1.2 * size_px
    depth = uniform(count, low=2.0, high=6.0)
    pixel = uniform(count, 2, low=-0.05, high=1.05) * size_px
    means = torch.cat([(pixel - size_px / 2) / focal_px * depth[:, None], depth[:, None]], -1)
    largest_px = torch.exp(uniform(count, low=math.log(2.0), high=math.log(8.0))) / 3
    ratios = torch.cat([torch.ones(count, 1), 1 / uniform(count, 2, low=1.0, high=5.0)], -1)
    scales = (largest_px * depth / focal_px)[:, None] * ratios
    K = torch.tensor([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
    camera = Camera(width=size_px, height=size_px, K=K, world_to_camera=torch.eye(4))
    splats = Splats(
        means=means[None],
        quaternions=torch.randn(count, 4, generator=generator),
        scales=scales,
        opacities=uniform(count, low=0.1, high=0.9),
        channels=uniform(1, count, channels),
    )
    planar = torch.randn(1, channels, size_px, size_px, generator=generator)
    alpha_grad = torch.randn(1, size_px, size_px, generator=generator)
    return Scene(splats, camera, planar.permute(0, 2, 3, 1), alpha_grad)


@dataclass(frozen=True)
class Timing:
    """Milliseconds of repeated runs; the best is what an undisturbed machine does."""

    best: float
    median: float

    def __str__(self) -> str:
        return f"{self.best:.2f} ms (median {self.median:.2f})"


def timed(run: Callable[[], object], repeats: int) -> Timing:
    """Time ``repeats`` runs after two that warm up."""
    times = []
    for i in range(repeats + 2):
        start = time.perf_counter()
        run()
        if i >= 2:
            times.append(1e3 * (time.perf_counter() - start))
    return Timing(min(times), statistics.median(times))


def measure(scene: Scene, backend: str, repeats: int) -> tuple[Timing, Timing]:
    """Forward and forward+backward (to every input and the camera)."""
    fields = {
        name: getattr(scene.splats, name).clone().requires_grad_()
        for name in ("means", "quaternions", "scales", "opacities", "channels")
    }
    pose = scene.camera.world_to_camera.clone().requires_grad_()
    camera = replace(scene.camera, world_to_camera=pose)

    def forward() -> None:
        with torch.no_grad():
            render(scene.splats, scene.camera, backend=backend)  # type: ignore[arg-type]

    def both() -> None:
        out = render(Splats(**fields), camera, backend=backend)  # type: ignore[arg-type]
        torch.autograd.grad(
            [out.image, out.alpha], [*fields.values(), pose], [scene.image_grad, scene.alpha_grad]
        )

    return timed(forward, repeats), timed(both, repeats)


def native_job(scene: Scene) -> _native.Render:
    """The forward pass as the extension sees it, to read its counters."""
    s, camera = scene.splats, scene.camera
    size = (camera.height, camera.width)
    channels = s.channels.shape[-1]
    fields = [
        s.means,
        s.quaternions[None],
        s.scales[None],
        s.opacities[None],
        s.channels,
        None,
        None,
    ]
    job = _native.Render(
        camera.width, camera.height, camera.K, camera.world_to_camera, 0.01, LOW_PASS, fields, [],
        None, None, 1, torch.get_num_threads(),
    )  # fmt: skip
    job.forward(
        torch.empty(1, channels, *size), torch.empty(1, *size),
        torch.empty(1, s.means.shape[1], dtype=torch.int32), torch.empty(1, 0, dtype=torch.int32),
    )  # fmt: skip
    return job


def stages(scene: Scene, repeats: int) -> tuple[dict[str, float], int]:
    """Best milliseconds of each stage on one thread, and the least page faults of a render."""
    torch.set_num_threads(1)
    best: dict[str, float] = {}
    faults = []
    s = scene.splats
    for _ in range(repeats + 2):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        job = native_job(scene)
        fields = (s.means, s.quaternions[None], s.scales[None], s.opacities[None], s.channels)
        grads = [*map(torch.zeros_like, fields), None, None]
        job.backward(
            list(scene.image_grad), (s.channels.shape[-1],), scene.alpha_grad, grads, [],
            torch.zeros(12), None, None,
        )  # fmt: skip
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
        for stage, seconds in job.seconds.items():
            best[stage] = min(best.get(stage, math.inf), 1e3 * seconds)
    return best, min(faults)


def covering(size_px: int, count: int) -> Scene:
    """Wide faint Gaussians: each reaches all pixels, and hides so little that every one counts."""
    scene = make_scene(size_px, count, 4)
    depth = scene.splats.means[0, :, 2]
    means = torch.stack([torch.zeros(count), torch.zeros(count), depth], -1)
    scales = 2 * depth[:, None].expand(-1, 3).contiguous()
    opacities = torch.linspace(0.01, 0.02, count)
    splats = replace(scene.splats, means=means[None], scales=scales, opacities=opacities)
    return replace(scene, splats=splats)


def limits(scene: Scene, repeats: int) -> dict[str, float]:
    """Share of the core's peak that compositing alone makes, one thread, and what takes the rest.

    Besides the scene: as many Gaussians per tile in so small a picture that all stay in the cache,
    and Gaussians that reach every pixel, so that nothing is lost between short runs of patches.
    """
    size_px, count = scene.camera.width, scene.splats.means.shape[1]
    small_px, channels = 64, scene.splats.channels.shape[-1]
    in_cache = make_scene(small_px, count * small_px**2 // size_px**2, channels)
    scenes = {
        "the scene": (scene, repeats),
        "the same in the cache": (in_cache, 20 * repeats),
        "whole tiles in the cache": (covering(128, 64), 20 * repeats),
    }
    result = {}
    for name, (given, times) in scenes.items():
        best, _ = stages(given, times)
        job, of_peak = native_job(given), peak_flops()
        lanes = job.patch_steps * _native.lanes()
        per_pair = job.patch_steps / job.intersections
        print(f"  {name}: {per_pair:.1f} patch steps per Gaussian and tile", end="")
        for stage, direction in (("composite", "forward"), ("composite_backward", "backward")):
            constant, per_channel = FLOP_PER_LANE[direction]
            flop = lanes * (constant + per_channel * given.splats.channels.shape[-1])
            share = flop / (1e-3 * best[stage]) / of_peak
            result[f"{name}_{direction}_share_of_core_peak".replace(" ", "_")] = round(share, 3)
            print(f", {direction} {share:.0%} of the peak", end="")
        print()
    return result


def with_gradient(splats: Splats) -> Splats:
    """The same with every field a leaf."""
    return replace(
        splats,
        **{
            name: value.clone().requires_grad_()
            for name, value in vars(splats).items()
            if value is not None
        },
    )


@dataclass(frozen=True)
class TwoLayers:
    """A person that moves over a scene that does not."""

    moving: Splats
    static: Splats
    camera: Camera
    image_grad: torch.Tensor
    low_pass: float = LOW_PASS


def person_over_scene(size_px: int, channels: int, times: int) -> TwoLayers:
    """20,000 Gaussians in a box of 15 % of the picture, moving by pixels, over 30,000."""
    static = make_scene(size_px, 30_000, channels)
    person = make_scene(size_px, 20_000, channels, seed=1).splats
    means = person.means[0] * torch.tensor([0.27, 0.55, 1.0])
    means = torch.stack([means + 0.01 * t for t in range(times)])
    return TwoLayers(replace(person, means=means), static.splats, static.camera, static.image_grad)


def trained_person(path: Path, times: int) -> TwoLayers:
    """A trained person over its scene at even times of the middle training frame's exposure."""
    run = evsplat.load_run(path, device="cpu")
    frame = run.capture.train_frames[len(run.capture.train_frames) // 2]
    camera, (start, end) = run.capture.camera(frame), frame.exposure_us
    at = [start + (end - start) * time // (times - 1) for time in range(times)]
    moving, static = run.reconstruction.splats(camera, at)
    # One picture has one shadow; what the scene's colours are costs nothing.
    static = replace(static, channels=static.channels[:1])
    channels = static.channels.shape[-1]
    grad = torch.randn(1, channels, camera.height, camera.width).permute(0, 2, 3, 1)
    low_pass = run.reconstruction.low_pass
    alpha = render(moving, camera, low_pass=low_pass).alpha[:1, None]
    touched = torch.nn.functional.max_pool2d(alpha, 16, ceil_mode=True) > 0
    print(
        f"  {path}: {camera.width}x{camera.height} px, {moving.means.shape[1]} Gaussians in "
        f"{touched.float().mean():.0%} of the tiles over {static.means.shape[1]}"
    )
    return TwoLayers(moving, static, camera, grad, low_pass)


def many_times(scene: TwoLayers, repeats: int) -> dict[str, float]:
    """Forward+backward of a person over a static scene: one time, five, five without sharing."""

    def measured(name: str, moving: Splats, fixed: Splats | None) -> tuple[float, int]:
        moving = with_gradient(moving)
        fixed = None if fixed is None else with_gradient(fixed)
        grad = scene.image_grad.expand(len(moving.means), -1, -1, -1)
        layers = [layer for layer in (moving, fixed) if layer is not None]
        leaves = [v for layer in layers for v in vars(layer).values() if v is not None]

        def both() -> None:
            out = render(moving, scene.camera, static=fixed, low_pass=scene.low_pass)
            torch.autograd.grad(out.image, leaves, grad)

        timing = timed(both, repeats)
        alpha = render(moving, scene.camera, static=fixed, low_pass=scene.low_pass).alpha
        steps = alpha.grad_fn.kept.patch_steps  # type: ignore[union-attr]
        print(f"  {name}: {timing}, {steps} patch steps")
        return timing.best, steps

    given = vars(scene.moving).items()
    first = Splats(**{n: v if v is None or v.ndim < 3 else v[:1] for n, v in given})
    single, single_steps = measured("person and scene, 1 time", first, scene.static)
    shared, shared_steps = measured("person and scene, 5 times", scene.moving, scene.static)
    everything = join(scene.moving.with_times(), scene.static.with_times(), 5)
    apart, _ = measured("the same without sharing", everything, None)
    print(
        f"  five times cost {shared / single:.2f} single renders, {apart / single:.2f} without "
        f"sharing; they are {shared_steps / single_steps:.2f} times as many patch steps"
    )
    return {
        "person_and_scene_1_time_best_ms": round(single, 2),
        "person_and_scene_5_times_best_ms": round(shared, 2),
        "five_times_over_one": round(shared / single, 2),
        "five_times_unshared_over_one": round(apart / single, 2),
        "five_times_patch_steps_over_one": round(shared_steps / single_steps, 2),
    }


def peak_flops() -> float:
    """Multiply-add peak of one core, FLOP/s."""
    best = 0.0
    for _ in range(100):  # short, so that one of them is undisturbed
        start = time.perf_counter()
        operations = _native.multiply_add(200_000)
        best = max(best, operations / (time.perf_counter() - start))
    return best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="image side, px")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--channels", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--run", type=Path, help="a trained run folder")
    args = parser.parse_args()

    level = _native.level()
    scene = make_scene(args.size, args.gaussians, args.channels)
    result: dict[str, float | int | str] = {
        "simd_level": level,
        "image_px": args.size,
        "gaussians": args.gaussians,
        "channels": args.channels,
    }
    print(
        f"{args.size}x{args.size} px, {args.gaussians} Gaussians, {args.channels} channels, {level}"
    )
    timings = {}
    for threads in (1, 2):
        torch.set_num_threads(threads)
        timings[threads] = forward, both = measure(scene, "native", args.repeats)
        print(f"  {threads} thread(s): forward {forward}, forward+backward {both}")
        for name, timing in (("forward", forward), ("forward_backward", both)):
            result[f"{name}_{threads}thread_best_ms"] = round(timing.best, 2)
            result[f"{name}_{threads}thread_median_ms"] = round(timing.median, 2)

    job = native_job(scene)
    result |= {"tile_intersections": job.intersections, "patch_steps": job.patch_steps}
    print(f"  {job.intersections} tile intersections, {job.patch_steps} patch steps")
    result |= arithmetic(job.patch_steps * _native.lanes(), args.channels, *timings[1])

    best, faults = stages(scene, args.repeats)
    result |= limits(scene, args.repeats)
    torch.set_num_threads(2)
    print("  stages on 1 thread: " + ", ".join(f"{k} {v:.2f} ms" for k, v in best.items()))
    print(f"  page faults of a render: {faults}")
    result |= {f"{stage}_1thread_best_ms": round(value, 2) for stage, value in best.items()}
    result |= {"page_faults_of_a_render": faults}

    result |= against_reference(args.channels)
    result |= many_times(person_over_scene(args.size, args.channels, 5), args.repeats)
    if args.run is not None:
        of_run = many_times(trained_person(args.run, 5), args.repeats)
        result |= {f"run_{name}": value for name, value in of_run.items()}
    peak_rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result |= {"kept_for_backward_mb": round(job.bytes / 1e6, 2)}
    result |= {"peak_rss_mb": round(peak_rss / 1e3)}
    print(
        f"  kept for the backward pass {job.bytes / 1e6:.1f} MB; peak RSS {peak_rss / 1e3:.0f} MB, "
        "torch and the reference included"
    )
    print(json.dumps(result))


def against_reference(channels: int) -> dict[str, float]:
    """How much faster than the reference in torch a small scene is drawn, with gradients."""
    small = make_scene(128, 1000, channels)
    native, reference = measure(small, "native", 15)[1], measure(small, "reference", 3)[1]
    ratio = reference.best / native.best
    print(
        f"  128x128 px, 1000 Gaussians, forward+backward, 2 threads: native {native}, "
        f"torch reference {reference}: {ratio:.0f} times as fast"
    )
    return {
        "small_scene_native_best_ms": round(native.best, 3),
        "small_scene_reference_best_ms": round(reference.best, 1),
        "native_speed_over_reference": round(ratio, 1),
    }


def arithmetic(lanes: int, channels: int, forward: Timing, both: Timing) -> dict[str, float]:
    """Share of the core's peak that compositing makes of the whole pass, sorting and all."""
    peak = peak_flops()
    work = {
        name: lanes * (constant + per_channel * channels)
        for name, (constant, per_channel) in FLOP_PER_LANE.items()
    }
    shares = {
        "forward": work["forward"] / (1e-3 * forward.best) / peak,
        "forward_backward": sum(work.values()) / (1e-3 * both.best) / peak,
    }
    print(
        f"  multiply-add peak of a core {peak / 1e9:.0f} GFLOP/s; on 1 thread compositing, over "
        f"the time of everything, is {shares['forward']:.0%} of it forward, "
        f"{shares['forward_backward']:.0%} forward+backward"
    )
    return {
        "core_peak_gflops": round(peak / 1e9, 1),
        "compositing_forward_gflop": round(work["forward"] / 1e9, 4),
        "compositing_backward_gflop": round(work["backward"] / 1e9, 4),
        **{f"{name}_share_of_core_peak": round(share, 3) for name, share in shares.items()},
    }


if __name__ == "__main__":
    main()
