from dataclasses import dataclass, fields, replace

import pytest
import torch

from evsplat.render import LOW_PASS, RenderOutput, Splats, render


@dataclass(frozen=True)
class PlainCamera:
    width: int
    height: int
    K: torch.Tensor
    world_to_camera: torch.Tensor


def rotation(axis_angle):
    x, y, z = axis_angle.tolist()
    return torch.linalg.matrix_exp(
        torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    ).float()


def random_scene(
    seed,
    *,
    count=200,
    times=1,
    channels=3,
    width=61,
    height=45,
    linear=False,
    shared=False,
    needle=20,
):
    """Float32 Gaussians all over the place, under a turned camera.

    A tenth lies behind the camera or right at it, a fifth outside or across the image border, a
    tenth is ``needle`` times longer than wide; opacities include 0.9999, 0.005 and 0.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    K = torch.tensor([[60.0, 0, width / 2 + 1.3], [0, 64.0, height / 2 - 0.7], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = rotation(0.3 * normal(3))
    pose[:3, 3] = 0.2 * normal(3)
    lead = () if shared else (times,)
    depth = 1 + 3 * uniform(times, count)
    depth[:, : count // 10] -= 2.5
    pixel = (1.4 * uniform(times, count, 2) - 0.2) * torch.tensor([width, height])
    ray = torch.cat([(pixel - K[:2, 2]) / K.diagonal()[:2], torch.ones(times, count, 1)], -1)
    means = (ray * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
    scales = torch.exp(2.5 * uniform(*lead, count, 3) - 4)
    scales[..., count // 2 : count // 2 + count // 10, 0] *= needle
    opacities = uniform(*lead, count)
    opacities[..., ::7] = 0.9999
    opacities[..., 1::11] = 0.005
    opacities[..., 2::23] = 0
    matrices = torch.eye(3) + 0.2 * normal(times, count, 3, 3) if linear else None
    splats = Splats(
        means=means,
        quaternions=normal(*lead, count, 4),
        scales=scales,
        opacities=opacities,
        channels=normal(times, count, channels),
        linear=matrices,
    )
    return splats, PlainCamera(width, height, K, pose)


def all_gradients(
    splats,
    camera,
    *,
    backend,
    dtype,
    static=None,
    background=None,
    seed=0,
    device="cpu",
    low_pass=LOW_PASS,
):
    """The render and the gradient of a fixed random projection of it, for every input, on the CPU.

    The tensors are rendered on ``device``.
    """

    def leaves_of(layer):
        leaves = {
            field.name: getattr(layer, field.name).to(device, dtype).clone().requires_grad_()
            for field in fields(Splats)
            if getattr(layer, field.name) is not None
        }
        shape = (*layer.means.shape[:2], 2)
        leaves["centers2d_offset"] = torch.zeros(
            shape, dtype=dtype, device=device, requires_grad=True
        )
        return leaves

    leaves = leaves_of(splats)
    inputs, still = Splats(**leaves), None
    if static is not None:
        of_static = leaves_of(static)
        still = Splats(**of_static)
        leaves |= {f"static {name}": leaf for name, leaf in of_static.items()}
    leaves["pose"] = camera.world_to_camera.to(device, dtype).clone().requires_grad_()
    if background is not None:
        leaves["background"] = background.to(device, dtype).clone().requires_grad_()
    out = render(
        inputs,
        replace(camera, world_to_camera=leaves["pose"]),
        static=still,
        background=leaves.get("background"),
        low_pass=low_pass,
        backend=backend,
    )
    generator = torch.Generator().manual_seed(seed)
    loss = sum(
        (value * torch.randn(value.shape, generator=generator).to(device)).sum()
        for value in (out.image, out.alpha)
    )
    gradients = [value.cpu() for value in torch.autograd.grad(loss, list(leaves.values()))]
    out = RenderOutput(*(x.cpu() for x in (out.image, out.alpha, out.radii, out.static_radii)))
    return out, dict(zip(leaves, gradients, strict=True))


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(name="random_scene")
def _random_scene():
    return random_scene


@pytest.fixture(name="all_gradients")
def _all_gradients():
    return all_gradients


@pytest.fixture
def camera():
    """Looks along z; one metre away, one metre is 50 px."""
    K = torch.tensor([[50.0, 0, 20.5], [0, 50.0, 16.5], [0, 0, 1]])
    return PlainCamera(41, 33, K, torch.eye(4))


@pytest.fixture
def pile():
    """300 faint Gaussians at one place, numbered by their channel, and what is seen at its middle.

    Front to back in the order of their rows.
    """
    count = 300
    splats = Splats(
        means=torch.tensor([[[0.0, 0, 1.0]]]).expand(1, count, 3),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        scales=torch.full((count, 3), 0.2),
        opacities=torch.full((count,), 0.02),
        channels=torch.arange(count).float()[None, :, None],
    )
    alpha = torch.tensor(0.02, dtype=torch.float64)
    weights = alpha * (1 - alpha) ** torch.arange(count)
    return splats, (weights * torch.arange(count)).sum().item()
