"""Time of the networks for motion and colour, forward and backward, beside the limit of the cores.

python benchmarks/networks.py [--points N] [--times T] [--repeats R]

The limit is the time of the same multiply-adds at the measured peak of the cores: the share says
what a perfect implementation of the same arithmetic would save (on AMX, whose tiles are faster than
vectors, it may be above one). torch's own products of the widest layer's size are told beside it.
The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import time
from collections.abc import Callable

import torch
from rasterize import peak_flops
from torch import Tensor, nn

from evsplat.body import default_body
from evsplat.models.networks.colour import HumanColour, SceneColour
from evsplat.models.networks.non_rigid import NonRigidNetwork
from evsplat.models.networks.pose_encoder import PoseEncoder, normalise_joints
from evsplat.models.networks.skinning_network import SkinningNetwork


def main() -> None:
    """Print a table per thread count and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=15_000)
    parser.add_argument("--times", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=10)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    results: dict[str, float] = {"points": arguments.points, "times": arguments.times}
    cases = _cases(arguments.points, arguments.times)
    for threads in (1, 2):
        torch.set_num_threads(threads)
        gemm, peak = _gemm_flops(arguments.repeats), threads * peak_flops()
        print(f"{threads} thread(s): peak {peak / 1e9:.0f} GFLOP/s, torch's GEMM {gemm / 1e9:.0f}")
        results[f"peak_{threads}t_gflops"] = round(peak / 1e9, 1)
        results[f"gemm_{threads}t_gflops"] = round(gemm / 1e9, 1)
        for name, (step, flops) in cases.items():
            milliseconds = _time(step, arguments.repeats)
            share = 1e3 * flops / milliseconds / peak
            print(f"  {name:22s} {milliseconds:8.2f} ms   {100 * share:5.1f} % of the peak")
            results[f"{name}_{threads}t_ms"] = round(milliseconds, 3)
            results[f"{name}_{threads}t_peak_percent"] = round(100 * share, 1)
    print(json.dumps(results))


def _cases(points: int, times: int) -> dict[str, tuple[Callable[[], object], float]]:
    """Name -> (one forward and backward, its matrix products in floating-point operations)."""
    body = default_body()
    parents = body.parents.tolist()
    joints = len(parents)
    encoder = PoseEncoder(parents, normalise_joints(body.rest_joints, body.rest_vertices))
    skinning = SkinningNetwork(parents)
    human, scene = HumanColour(), SceneColour()
    positions = (torch.rand(points, 3) * 2 - 1).requires_grad_()
    posed = (torch.rand(times, points, 3) * 2 - 1).requires_grad_()
    rotations = torch.linalg.qr(torch.randn(times, joints, 3, 3)).Q
    pose = torch.randn(times, encoder.dim, requires_grad=True)
    features = torch.zeros(points, 32, requires_grad=True)
    directions = nn.functional.normalize(torch.randn(times, points, 3), dim=-1).requires_grad_()
    carried = torch.randn(times, points, 16, requires_grad=True)
    latent = torch.randn(times, 16, requires_grad=True)
    rows = points * times
    # Forward, gradient to inputs and gradient to weights are three products of equal size.
    hidden = 6 * rows * 128 * 128
    cases: dict[str, tuple[Callable[[], object], float]] = {
        "pose_encoder": (
            lambda: _step(encoder(rotations)),
            6 * times * (joints * 19 * 25 + 12 * joints * 6),
        )
    }
    network = NonRigidNetwork(encoder.dim, last_layer_std=None)
    encoding = network.encoding
    cases["encoding"] = (lambda: _step(encoding(0.5 * (positions + 1))), 0.0)

    def non_rigid() -> None:
        out = network(encoding(0.5 * (positions + 1)), pose)
        _step(out.changes)

    products = 6 * points * encoding.dim * 128 + 2 * hidden + 6 * rows * 128 * 25
    cases["non_rigid"] = (non_rigid, products)
    products = 6 * rows * 128 * (3 + skinning.softmax.logits) + 3 * hidden
    cases["skinning"] = (lambda: _step(skinning(posed)), products)
    cases["human_colour"] = (
        lambda: _step(human(features, directions, carried, latent)),
        6 * (points * 32 * 64 + rows * (31 * 64 + 64 * 64 + 64 * 3)),
    )
    static = directions[0].detach()
    cases["scene_colour"] = (
        lambda: _step(scene(features, static)),
        6 * points * (47 * 64 + 64 * 64 + 64 * 3),
    )
    return cases


def _step(*outputs: Tensor) -> None:
    torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])


def _gemm_flops(repeats: int) -> float:
    """FLOP/s of torch's product for a 128-wide layer on a cache-sized chunk."""
    points, weight = torch.randn(2048, 128), torch.randn(128, 128)
    return 2e3 * 2048 * 128 * 128 / _time(lambda: torch.mm(points, weight), 20 * repeats)


def _time(step: Callable[[], object], repeats: int) -> float:
    """Best milliseconds after two warm-up calls: what the machine does when left alone."""
    samples = []
    for repeat in range(repeats + 2):
        start = time.perf_counter()
        step()
        if repeat >= 2:
            samples.append(1e3 * (time.perf_counter() - start))
    return min(samples)


if __name__ == "__main__":
    main()
