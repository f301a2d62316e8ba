"""A light on the static layer alone, for backends that know of none."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from evsplat.render.job import RenderJob
from evsplat.render.splats import RenderOutput

LIT_CHANNELS = 3
"""The first ones: colour."""
MOST_LIT = 32
"""Channels that are drawn with a light."""


def lit_apart(job: RenderJob, draw: Callable[[RenderJob], RenderOutput]) -> RenderOutput:
    """Colours of both layers as channels of their own, so that the static one's can be multiplied.

    They are composited in one pass and in the right order of depth.
    """
    assert job.static_light is not None and job.static is not None
    moving, static, background = job.splats, job.static, job.background
    apart = replace(
        job,
        splats=replace(moving, channels=_widened(moving.channels, after=True)),
        static=replace(static, channels=_widened(static.channels, after=False)),
        background=None if background is None else _widened(background, after=False),
        static_light=None,
    )
    drawn = draw(apart)
    rest = drawn.image.shape[-1] - 2 * LIT_CHANNELS
    first, second, others = drawn.image.split((LIT_CHANNELS, LIT_CHANNELS, rest), -1)
    lit = first + second * job.static_light[..., None]
    return replace(drawn, image=torch.cat([lit, others], -1))


def _widened(channels: Tensor, *, after: bool) -> Tensor:
    """Zeros in place of the other layer's colour, before or after the own."""
    colour, rest = channels[..., :LIT_CHANNELS], channels[..., LIT_CHANNELS:]
    widths = (0, LIT_CHANNELS) if after else (LIT_CHANNELS, 0)
    return torch.cat([F.pad(colour, widths), rest], -1)
