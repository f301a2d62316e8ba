"""Pictures taken apart by channels: views whose gradients come back in one tensor."""

from dataclasses import fields

import pytest
import torch

from evsplat.errors import BackendError
from evsplat.render import Splats, render
from evsplat.render.splats import split_channels


@pytest.mark.parametrize("seed", range(3))
def test_parts_and_gradient_are_those_of_torchs_split(seed):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(3, 4, 5, 6, generator=generator).permute(0, 2, 3, 1)
    upstream = torch.rand(image.shape, generator=generator)
    ours, theirs = image.clone().requires_grad_(), image.clone().requires_grad_()
    rgb, rest = split_channels(ours, (3, 1))
    expected = [part.unbind(0) for part in theirs.split((3, 1), -1)]
    for group, want in zip((rgb, rest), expected, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(group, want, strict=True))
    # Nothing looks at the second picture's colours: their gradient is zero.
    for parts in ((rgb, rest), expected):
        used = [(parts[0][0], upstream[0, ..., :3]), (parts[0][2], upstream[2, ..., :3])]
        used += [(parts[1][t], upstream[t, ..., 3:]) for t in range(3)]
        torch.stack([(part * weight).sum() for part, weight in used]).sum().backward()
    assert torch.equal(ours.grad, theirs.grad)


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_through_groups_are_those_through_the_image(seed, lit, random_scene):
    size, times, groups = dict(width=70, height=53), 3, (3, 1, 2)
    moving, camera = random_scene(seed, count=40, times=times, channels=6, **size)
    static, _ = random_scene(seed + 100, count=60, channels=6, **size)
    generator = torch.Generator().manual_seed(seed)
    light = torch.rand(times, size["height"], size["width"], generator=generator) if lit else None

    def gradients(grouped):
        leaves = [
            {f.name: getattr(layer, f.name).clone().requires_grad_() for f in fields(Splats)
             if getattr(layer, f.name) is not None}
            for layer in (moving, static)
        ]  # fmt: skip
        output = render(
            Splats(**leaves[0]),
            camera,
            static=Splats(**leaves[1]),
            static_light=light,
            groups=groups if grouped else (),
        )
        parts = output.groups if grouped else split_channels(output.image, groups)
        assert torch.equal(torch.stack(parts[2]), output.image[..., 4:])
        draws = torch.Generator().manual_seed(seed)
        # Every layout that losses have: planar, of whole pixels, one value for all; or none at all.
        planar = torch.randn(3, *parts[0][0].shape[:2], generator=draws).permute(1, 2, 0)
        pixels = torch.randn(parts[0][0].shape, generator=draws)
        loss = (parts[0][0] * planar).sum() + (parts[0][2] * pixels).sum() + parts[1][1].mean()
        (loss + sum((part * part).sum() for part in parts[2]) + output.alpha[1].sum()).backward()
        return [leaf.grad for layer in leaves for leaf in layer.values()]

    assert all(map(torch.equal, gradients(True), gradients(False)))


def test_groups_that_leave_channels_out_are_refused(random_scene):
    moving, camera = random_scene(0, count=3, channels=4, width=20, height=20)
    with pytest.raises(BackendError, match=r"groups are \[3\], together 3, expected 4"):
        render(moving, camera, groups=(3,))
