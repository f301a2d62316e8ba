"""Gaps of a solid scene have its colour, and where it ends nothing changes."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from evsplat.film import Look
from evsplat.film.gaps import close_gaps
from evsplat.methods.reconstruction import Rendering

COLOUR = torch.tensor([0.2, 0.5, 0.7])
SIZES = [(96, 130), (300, 240)]


def pictured(rng, height, width):
    """An even scene with gaps in every ninth pixel, and which those are."""
    alpha = torch.ones(1, height, width)
    gaps = torch.zeros_like(alpha, dtype=torch.bool)
    gaps[:, ::3, ::3] = True
    alpha[gaps] = torch.from_numpy(rng.uniform(0.25, 0.8, int(gaps.sum()))).float()
    return alpha[..., None] * COLOUR, alpha, gaps


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_gaps_have_the_colour_about_them_and_nothing_shows_behind(rng, height, width):
    rgb, alpha, gaps = pictured(rng, height, width)
    closed, solid = close_gaps(rgb, alpha, torch.zeros_like(alpha))
    assert torch.allclose(solid, torch.ones_like(solid))
    # All but the share that colours are trained to make up for.
    wanted = (alpha + ((1 - alpha - 0.15) / 0.85).clamp_min(0))[..., None] * COLOUR
    assert torch.allclose(closed, wanted, atol=1e-5)
    assert torch.equal(closed[~gaps], rgb[~gaps])


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_where_the_scene_ends_nothing_is_closed(rng, height, width):
    rgb, alpha, _ = pictured(rng, height, width)
    half = width // 2
    alpha[..., half:], rgb[:, :, half:] = 0, 0
    closed, solid = close_gaps(rgb, alpha, torch.zeros_like(alpha))
    far = half + 3 * max(1, round(min(height, width) / 96))
    assert float(solid[..., far:].max()) == 0 and float(closed[:, :, far:].max()) == 0
    assert torch.allclose(solid[..., : 2 * half - far], torch.ones(1))


def test_nothing_of_the_person_goes_into_gaps_beside_them(rng):
    rgb, alpha, gaps = pictured(rng, 120, 120)
    human = torch.zeros_like(alpha)
    human[:, 40:80, 40:80] = 1
    rgb[:, 40:80, 40:80], alpha[:, 40:80, 40:80] = torch.tensor([0.0, 1.0, 0.0]), 1
    closed, _ = close_gaps(rgb, alpha, human)
    beside = gaps & (human == 0)
    hues = closed[beside] / closed[beside].sum(-1, keepdim=True).clamp_min(1e-6)
    assert torch.allclose(hues, COLOUR / COLOUR.sum(), atol=1e-4)
    assert torch.equal(closed[human == 1], rgb[human == 1])


@pytest.mark.parametrize("parts", ["all", "scene", "human"])
def test_cut_out_scenes_are_opaque_and_as_bright_as_on_black(rng, parts):
    """A scene lets through a tenth, for which its colours make up; a lone person's edge stays."""
    rgb = torch.from_numpy(rng.uniform(0.2, 0.7, (1, 96, 96, 3))).float()
    alpha = torch.full((1, 96, 96), 0.9)
    drawn = Rendering(rgb, alpha, alpha if parts == "human" else torch.zeros_like(alpha))
    reconstruction = SimpleNamespace(render=lambda *_, **__: drawn)
    look = Look(parts=parts, transparent=True)
    (found,) = look.expose(cast(Any, reconstruction), cast(Any, None), [0])
    colour, opacity = (rgb / 0.9, 0.9) if parts == "human" else (rgb, 1.0)
    assert np.abs(found[..., :3] - 255 * colour[0].numpy()).max() <= 0.51
    assert np.abs(found[..., 3] - 255 * opacity).max() <= 0.51
