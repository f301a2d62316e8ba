"""Time of the native kernels beside plain torch, and of the neighbour search beside SciPy's.

python benchmarks/kernels.py [--points N] [--size PX] [--threads T] [--repeats R]

All but the search are forward and backward. The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import time
from collections.abc import Callable
from types import ModuleType
from unittest import mock

import torch
from scipy.spatial import cKDTree

from evsplat.body import body
from evsplat.deform import encodings
from evsplat.imaging import events
from evsplat.neighbours import nearest
from evsplat.objectives import isometry
from evsplat.similarity.psnr_ssim import GAUSSIAN_SSIM, ssim, ssim_map

Call = Callable[[], object]


def main() -> None:
    """Print a table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=512, help="image side, px")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    results: dict[str, float] = {
        "points": arguments.points,
        "image_px": arguments.size,
        "threads": arguments.threads,
    }
    print(f"{arguments.threads} thread(s)")
    for name, (native, plain) in cases(arguments.points, arguments.size).items():
        ours, theirs = best_ms(native, arguments.repeats), best_ms(plain, 3)
        print(f"  {name:14s} native {ours:7.2f} ms   peer {theirs:8.2f} ms   {theirs / ours:.1f}x")
        results |= {
            f"{name}_native_best_ms": round(ours, 2),
            f"{name}_peer_best_ms": round(theirs, 2),
            f"{name}_peer_over_native": round(theirs / ours, 1),
        }
    print(json.dumps(results))


def cases(points: int, size: int) -> dict[str, tuple[Call, Call]]:
    """Name -> (native, its peer), each one pass, backward too where there is a gradient."""
    image = torch.rand(3, size, size).permute(1, 2, 0).requires_grad_()
    truth = torch.rand(3, size, size).permute(1, 2, 0)
    grid = encodings.HashGridEncoding()
    positions = torch.rand(points, 3).requires_grad_()
    upstream = torch.randn(points, grid.dim)
    times, joints = 2, 31
    weights = torch.rand(points, joints).softmax(-1).requires_grad_()
    bones = torch.randn(times, joints, 4, 4)
    quaternions, log_scales = torch.randn(points, 4), torch.randn(points, 3)
    moved = [torch.randn(times, points, n).requires_grad_() for n in (3, 4, 3, 16)]
    moved[3] = moved[3].detach().unflatten(-1, (4, 4)).requires_grad_()
    rows = torch.randint(points, (1_024, 5))

    def hash_grid(lookup: type[torch.autograd.Function]) -> None:
        encoded = lookup.apply(positions, grid.table, grid).T
        torch.autograd.grad(encoded, (positions, grid.table), upstream)

    def skinning() -> None:
        carried, blended = body.skin(positions, weights, bones)
        torch.autograd.grad(carried.sum() + blended.sum(), (positions, weights))

    def isometric() -> None:
        terms = isometry.isometry_change(rows, (positions, quaternions, log_scales), tuple(moved))
        torch.autograd.grad(terms[0] + terms[1], (positions, *moved))

    def brightness() -> None:
        torch.autograd.grad(events.log_brightness(image).sum(), image)

    places = positions.detach()
    return {
        "ssim": (
            lambda: _backward(ssim(image, truth), image),
            lambda: _backward(ssim_map(image, truth, GAUSSIAN_SSIM).mean(), image),
        ),
        "hash_grid": (
            lambda: hash_grid(encodings._NativeLookup),
            lambda: hash_grid(encodings._TorchLookup),
        ),
        "skinning": (skinning, in_torch(skinning, body)),
        "isometry": (isometric, in_torch(isometric, isometry)),
        "log_brightness": (brightness, in_torch(brightness, events)),
        "neighbours": (
            lambda: nearest(places, 4),
            lambda: cKDTree(places.numpy()).query(places.numpy(), k=5),
        ),
    }


def in_torch(call: Call, module: ModuleType) -> Call:
    """The same call where ``module`` leaves everything to torch."""

    def run() -> None:
        with mock.patch.object(module, "runs_native", return_value=False):
            call()

    return run


def _backward(value: torch.Tensor, of: torch.Tensor) -> None:
    torch.autograd.grad(value, of)


def best_ms(run: Call, repeats: int) -> float:
    """Best of the repeats after one to warm up."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times[1:])


if __name__ == "__main__":
    main()
