"""Time of a step's native kernels beside plain torch, forward and backward.

python benchmarks/kernels.py [--points N] [--size PX] [--threads T] [--repeats R]

`benchmarks/networks.py` times the networks' layers, `benchmarks/rasterize.py` the rasteriser. The
last line is JSON with a unit in each key.
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

from evsplat import body
from evsplat.body import body as skin_module
from evsplat.models.discs import shading
from evsplat.models.networks import colour, non_rigid, skinning_network
from evsplat.objectives import event, isometry, semantic
from evsplat.pictures import light
from evsplat.similarity import psnr_ssim

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
        print(f"  {name:16s} native {ours:7.2f} ms   peer {theirs:8.2f} ms   {theirs / ours:.1f}x")
        results |= {
            f"{name}_native_best_ms": round(ours, 2),
            f"{name}_peer_best_ms": round(theirs, 2),
            f"{name}_peer_over_native": round(theirs / ours, 1),
        }
    print(json.dumps(results))


def cases(points: int, size: int) -> dict[str, tuple[Call, Call]]:
    """Name -> (native, its peer), each one pass, backward too where there is a gradient."""
    return picture_cases(size) | network_cases(points) | body_cases(points)


def picture_cases(size: int) -> dict[str, tuple[Call, Call]]:
    """What compares pictures and maps of a square picture."""
    image = torch.rand(3, size, size).permute(1, 2, 0).requires_grad_()
    truth = torch.rand(3, size, size).permute(1, 2, 0)
    change = torch.randn(size, size).requires_grad_()
    counts = torch.randn(size, size).round()
    share = torch.rand(size, size).requires_grad_()
    disc = (torch.arange(size) - size / 2).square()
    silhouette = (disc + disc[:, None] < (size / 5) ** 2).numpy()
    packed = semantic.PackedBounds.of(silhouette, band_px=size // 32)
    masks = packed.masks()

    def similarity() -> None:
        _backward(torch.add(*psnr_ssim.l1_and_ssim(image, truth)), image)

    def brightness() -> None:
        _backward(light.log_brightness(image).sum(), image)

    def power() -> None:
        _backward(light.decode(image).sum(), image)

    def event_maps() -> None:
        _backward(event.event_loss(change, counts), change)

    return {
        "ssim_and_l1": (similarity, in_torch(similarity, psnr_ssim)),
        "log_brightness": (brightness, in_torch(brightness, light)),
        "power_curve": (power, in_torch(power, light)),
        "event_loss": (event_maps, in_torch(event_maps, event)),
        "membership": (
            lambda: _backward(semantic.membership_loss(share, packed), share),
            lambda: _backward(semantic.membership_loss(share, masks), share),
        ),
    }


def network_cases(points: int) -> dict[str, tuple[Call, Call]]:
    """What lies before and behind the networks' layers, which `benchmarks/networks.py` times."""
    times = 2
    positions = torch.rand(points, 3).requires_grad_()
    blob = non_rigid.OneBlobEncoding()
    blob_upstream = torch.randn(points, blob.dim)
    softmax = skinning_network.HierarchicalSoftmax(body.default_body().parents.tolist())
    logits = torch.randn(points, softmax.logits).requires_grad_()
    changes = (0.1 * torch.randn(times, points, 25)).requires_grad_()
    shape = [torch.randn(points, n).requires_grad_() for n in (3, 3, 4)]
    transforms = torch.randn(times, points, 4, 4)
    world, feature = torch.randn(times, points, 3), torch.randn(times, points, 16)
    feature.requires_grad_()

    def encode() -> None:
        torch.autograd.grad(blob(positions), positions, blob_upstream)

    def tree_softmax() -> None:
        torch.autograd.grad(softmax(logits), logits, torch.ones(points, 1).expand(-1, joints))

    def change_shape() -> None:
        changed = non_rigid.NonRigid(changes).shape(*shape)
        torch.autograd.grad(changed, (changes, *shape), [torch.ones_like(v) for v in changed])

    def view_basis() -> None:
        seen = colour.view_directions(world, torch.zeros(3), transforms)
        _backward(colour.beside_basis(seen, feature).sum(), feature)

    joints = softmax(logits).shape[-1]
    return {
        "one_blob": (encode, in_torch(encode, non_rigid)),
        "skinning_softmax": (tree_softmax, in_torch(tree_softmax, skinning_network)),
        "shape_change": (change_shape, in_torch(change_shape, non_rigid)),
        "view_basis": (view_basis, in_torch(view_basis, colour)),
    }


def body_cases(points: int) -> dict[str, tuple[Call, Call]]:
    """What carries Gaussians into poses, and what compares them there."""
    times, joints = 2, 31
    positions = torch.rand(points, 3).requires_grad_()
    weights = torch.rand(points, joints).softmax(-1).requires_grad_()
    bones = torch.randn(times, joints, 4, 4)
    quaternions, log_scales = torch.randn(points, 4), torch.randn(points, 3)
    moved = [torch.randn(times, points, n).requires_grad_() for n in (3, 4, 3, 16)]
    moved[3] = moved[3].detach().unflatten(-1, (4, 4)).requires_grad_()
    rows = torch.randint(points, (1_024, 5))

    def skinning() -> None:
        carried, blended = skin_module.skin(positions, weights, bones)
        torch.autograd.grad(carried.sum() + blended.sum(), (positions, weights))

    def isometric() -> None:
        means, turns, scales, linear = moved
        at_rest, now = (positions, quaternions, log_scales), (means, turns, scales, linear)
        terms = isometry.isometry_change(rows, at_rest, now)
        torch.autograd.grad(terms[0] + terms[1], (positions, *moved))

    light = shading.SurfaceLight(
        shading.Shading(torch.zeros(3), 1.0, lamps=4),
        torch.nn.functional.normalize(torch.randn(points, 3), dim=-1),
        torch.randn(4, 3).requires_grad_(),
    )
    lit = torch.rand(4, 1, points).requires_grad_()
    carried = bones[:, :1].expand(-1, points, -1, -1).contiguous()
    stands = torch.rand(times, points, 3)

    def surface_light() -> None:
        factors = light.factors(carried, stands, lit)
        torch.autograd.grad(factors.sum(), (lit, *light.shading.parameters()))

    return {
        "surface_light": (surface_light, in_torch(surface_light, shading)),
        "skinning": (skinning, in_torch(skinning, skin_module)),
        "isometry": (isometric, in_torch(isometric, isometry)),
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
