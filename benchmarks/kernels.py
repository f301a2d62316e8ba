"""Time of the native kernels beside plain torch: SSIM, hash grid; and of the neighbour search.

python benchmarks/kernels.py [--points N] [--size PX] [--threads T] [--repeats R]

All are forward and backward. The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import time
from collections.abc import Callable

import torch
from scipy.spatial import cKDTree

from evsplat.deform import encodings
from evsplat.similarity.psnr_ssim import GAUSSIAN_SSIM, ssim, ssim_map


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
        print(f"  {name:10s} native {ours:7.2f} ms   torch {theirs:8.2f} ms   {theirs / ours:.0f}x")
        results |= {
            f"{name}_native_best_ms": round(ours, 2),
            f"{name}_torch_best_ms": round(theirs, 2),
            f"{name}_torch_over_native": round(theirs / ours, 1),
        }
    positions = torch.rand(arguments.points, 3).numpy()
    search = best_ms(lambda: cKDTree(positions).query(positions, k=5), 3)
    print(f"  neighbours scipy {search:7.2f} ms, once in 100 steps")
    results["neighbours_scipy_best_ms"] = round(search, 2)
    print(json.dumps(results))


def cases(points: int, size: int) -> dict[str, tuple[Callable[[], None], Callable[[], None]]]:
    """Name -> (native, plain torch), each one forward and backward pass."""
    image = torch.rand(3, size, size).permute(1, 2, 0).requires_grad_()
    truth = torch.rand(3, size, size).permute(1, 2, 0)
    grid = encodings.HashGridEncoding()
    positions = torch.rand(points, 3).requires_grad_()
    upstream = torch.randn(points, grid.dim)

    def hash_grid(lookup: type[torch.autograd.Function]) -> None:
        encoded = lookup.apply(positions, grid.table, grid).T
        torch.autograd.grad(encoded, (positions, grid.table), upstream)

    return {
        "ssim": (
            lambda: _backward(ssim(image, truth), image),
            lambda: _backward(ssim_map(image, truth, GAUSSIAN_SSIM).mean(), image),
        ),
        "hash_grid": (
            lambda: hash_grid(encodings._NativeLookup),
            lambda: hash_grid(encodings._TorchLookup),
        ),
    }


def _backward(value: torch.Tensor, of: torch.Tensor) -> None:
    torch.autograd.grad(value, of)


def best_ms(run: Callable[[], object], repeats: int) -> float:
    """Best of the repeats after one to warm up."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times[1:])


if __name__ == "__main__":
    main()
