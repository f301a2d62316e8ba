"""Pictures taken apart by channels: views whose gradients come back in one tensor."""

import pytest
import torch

from evsplat.render import split_channels


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
