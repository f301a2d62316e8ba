"""Speed of the native rasteriser on the random scene of many small Gaussians.

Prints forward and forward+backward times on 1 and 2 threads, the ratio to the torch reference on
a smaller scene, the share of one core's multiply-add peak, and memory. The last line is one JSON
object with the same numbers.
"""

import argparse
import json
import math
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import torch

from evsplat import _native
from evsplat.render import PinholeCamera, Splats, render

# Floating-point operations per lane of a patch, counted in native/kernels.cpp with C channels.
FORWARD_FLOP = (33, 2)  # constant, per channel
BACKWARD_FLOP = (58, 4)


@dataclass(frozen=True)
class Scene:
    """One frame's Gaussians and the gradient of its picture."""

    splats: Splats
    camera: PinholeCamera
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
    camera = SimpleNamespace(width=size_px, height=size_px, K=K, world_to_camera=torch.eye(4))
    splats = Splats(
        means=means[None],
        quats=torch.randn(count, 4, generator=generator),
        scales=scales,
        opacities=uniform(count, low=0.1, high=0.9),
        channels=uniform(1, count, channels),
    )
    planar = torch.randn(1, channels, size_px, size_px, generator=generator)
    alpha_grad = torch.randn(1, size_px, size_px, generator=generator)
    return Scene(splats, camera, planar.permute(0, 2, 3, 1), alpha_grad)


def timed_ms(run: Callable[[], object], repeats: int) -> float:
    """Median of ``repeats`` runs after two that warm up."""
    times = []
    for i in range(repeats + 2):
        start = time.perf_counter()
        run()
        if i >= 2:
            times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def measure(scene: Scene, backend: str, repeats: int) -> tuple[float, float]:
    """Forward and forward+backward (to every input and the camera), ms."""
    fields = {
        name: getattr(scene.splats, name).clone().requires_grad_()
        for name in ("means", "quats", "scales", "opacities", "channels")
    }
    pose = scene.camera.world_to_camera.clone().requires_grad_()
    camera = SimpleNamespace(
        width=scene.camera.width, height=scene.camera.height, K=scene.camera.K, world_to_camera=pose
    )

    def forward() -> None:
        with torch.no_grad():
            render(scene.splats, scene.camera, backend=backend)  # type: ignore[arg-type]

    def both() -> None:
        out = render(Splats(**fields), camera, backend=backend)  # type: ignore[arg-type]
        torch.autograd.grad(
            [out.image, out.alpha], [*fields.values(), pose], [scene.image_grad, scene.alpha_grad]
        )

    return timed_ms(forward, repeats), timed_ms(both, repeats)


def lane_work(scene: Scene) -> tuple[int, int]:
    """Patch steps of the forward pass (an upper bound: early stops not counted), intersections."""
    job = native_job(scene)
    return job.patch_steps, job.intersections


def native_job(scene: Scene):  # noqa: ANN201 - the extension's type has no stub
    """The forward pass as the extension sees it, to read its counters."""
    s, camera = scene.splats, scene.camera
    size = (camera.height, camera.width)
    channels = s.channels.shape[-1]
    job = _native.Render(
        camera.width, camera.height, camera.K, camera.world_to_camera, 0.01,
        s.means, s.quats[None], s.scales[None], s.opacities[None], s.channels, None, None, None,
        1, torch.get_num_threads(),
    )  # fmt: skip
    job.forward(
        torch.empty(1, channels, *size), torch.empty(1, *size),
        torch.empty(1, s.means.shape[1], dtype=torch.int32),
    )  # fmt: skip
    return job


def peak_flops() -> float:
    """Multiply-add peak of one core, FLOP/s."""
    best = 0.0
    for _ in range(5):
        start = time.perf_counter()
        operations = _native.multiply_add(3_000_000)
        best = max(best, operations / (time.perf_counter() - start))
    return best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="image side, px")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--channels", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()

    result: dict[str, float | int | str] = {
        "simd_level": _native.level(),
        "image_px": args.size,
        "gaussians": args.gaussians,
        "channels": args.channels,
    }
    scene = make_scene(args.size, args.gaussians, args.channels)
    print(f"{args.size}x{args.size}, {args.gaussians} Gaussians, {args.channels} channels, "
          f"{_native.level()}")  # fmt: skip
    for threads in (1, 2):
        torch.set_num_threads(threads)
        forward, both = measure(scene, "native", args.repeats)
        result[f"forward_{threads}thread_ms"] = round(forward, 2)
        result[f"forward_backward_{threads}thread_ms"] = round(both, 2)
        print(f"  {threads} thread(s): forward {forward:.2f} ms, forward+backward {both:.2f} ms")

    peak = peak_flops()
    steps, intersections = lane_work(scene)
    lanes = steps * _native.lanes()
    flop = {
        "forward": lanes * (FORWARD_FLOP[0] + FORWARD_FLOP[1] * args.channels),
        "backward": lanes * (BACKWARD_FLOP[0] + BACKWARD_FLOP[1] * args.channels),
    }
    forward, both = result["forward_1thread_ms"], result["forward_backward_1thread_ms"]
    share = 1e3 * (flop["forward"] + flop["backward"]) / float(both) / peak
    result |= {
        "core_peak_gflop_s": round(peak / 1e9, 1),
        "compositing_gflop_forward": round(flop["forward"] / 1e9, 4),
        "compositing_gflop_backward": round(flop["backward"] / 1e9, 4),
        "share_of_core_peak_forward": round(1e3 * flop["forward"] / float(forward) / peak, 3),
        "share_of_core_peak_forward_backward": round(share, 3),
        "tile_intersections": intersections,
        "patch_steps": steps,
    }
    print(f"  core peak {peak / 1e9:.0f} GFLOP/s; compositing uses {100 * share:.0f} % of it over the "
          "whole 1-thread forward+backward, projection and sorting included")  # fmt: skip
    print(f"  {intersections} tile intersections, {steps} patch steps")

    small = make_scene(128, 1000, args.channels)
    torch.set_num_threads(2)
    native, reference = measure(small, "native", 15)[1], measure(small, "reference", 2)[1]
    result |= {
        "small_scene_native_ms": round(native, 3),
        "small_scene_reference_ms": round(reference, 1),
        "native_over_reference_speed_ratio": round(reference / native, 1),
    }
    print(f"  128x128, 1000 Gaussians, 2 threads: native {native:.2f} ms, torch reference "
          f"{reference:.0f} ms, {reference / native:.0f} times slower")  # fmt: skip
    kept = native_job(scene).bytes
    peak_rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result |= {"kept_for_backward_mb": round(kept / 1e6, 2), "peak_rss_mb": round(peak_rss / 1e3)}
    print(f"  kept for the backward pass {kept / 1e6:.1f} MB; peak RSS {peak_rss / 1e3:.0f} MB, torch "
          "and the reference included")  # fmt: skip
    print(json.dumps(result))


if __name__ == "__main__":
    main()
