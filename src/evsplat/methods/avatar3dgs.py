"""Method `avatar3dgs`: 3DGS-Avatar, the person alone on black, learned from masked pictures.

Numbers of the form 1.5 are sections of the reference that docs/baselines.md quotes.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch

from evsplat.capture import Policy, TrainingCapture, load_body_track
from evsplat.capture.masked import MaskedCapture
from evsplat.config import AtLeast
from evsplat.gaussians import GaussianSet
from evsplat.methods.avatar_parts import (
    RELEASED_RATES,
    SURFACE_SAMPLES,
    AvatarRates,
    AvatarTerms,
    Networks,
    fitted_avatar,
    learning_of,
    picture_terms,
)
from evsplat.methods.base import (
    Composition,
    Purpose,
    require_training_frames,
    start_of_randomness,
)
from evsplat.methods.dropped import AVATAR
from evsplat.methods.settings import NOMINAL_ITERATIONS, Densify, Weight
from evsplat.methods.starts import HumanStart, Surface, human_start, no_gaussians
from evsplat.models.paper import RELEASED
from evsplat.objectives import Alpha

SURELY_PERSON = 20.0
"""Logit whose sigmoid is 1 to the last bit of float32: nothing moves it, and its channel of a
picture is the alpha picture."""


@dataclass(frozen=True)
class AvatarConfig:
    """All settings of method `avatar3dgs`."""

    DROPPED: ClassVar[dict[str, str]] = AVATAR

    policy: Policy = Policy(masks="given")
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""

    human: HumanStart = HumanStart(count=None, spacing_px=1.5)
    """Gaussians of the person at the start."""
    densify: Densify = Densify(start=1_000, end=10_000, gradient=2e-4, max_human=60_000)
    """Growth and pruning."""
    networks: Networks = Networks(pose_start=5_000)
    """Networks that move and colour the person."""

    l1_weight: Weight = 1.0
    """Weight of the mean absolute difference to the masked picture, sRGB."""
    dssim_weight: Weight = 0.0
    """Weight of 1 - SSIM."""
    alpha_weight: Weight = 0.1
    """Weight of the mean absolute difference between the alpha picture and the mask."""
    terms: AvatarTerms = AvatarTerms(perceptual="available")
    """Other terms of the loss."""

    rates: AvatarRates = RELEASED_RATES
    """Learning rates."""


def build(
    config: AvatarConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    purpose: Purpose = "train",
) -> Composition:
    """Put the method together for one capture; a `DataError` where it has no masks."""
    require_training_frames(capture)
    masked = MaskedCapture(capture, "method avatar3dgs")
    generator = start_of_randomness(seed)
    track = load_body_track(masked)
    times_us = [frame.mid_us for frame in masked.train_frames]
    surface = track.body.sample_surface(SURFACE_SAMPLES, generator)
    person = human_start(config.human, Surface(), masked, track, generator, SURELY_PERSON)
    model, prior = fitted_avatar(
        GaussianSet(person, no_gaussians()),
        track,
        times_us,
        surface,
        generator,
        semantics="fixed",
        networks=config.networks,
        scene_direction_dropout=0.0,
        released=RELEASED,
        skinning_steps=config.terms.skinning_prefit_steps if purpose == "train" else 0,
        device=device,
    )
    pictures, weights = picture_terms(
        masked,
        _boxes(masked),
        config.terms,
        config.l1_weight,
        config.dssim_weight,
        device=device,
        purpose=purpose,
    )
    return Composition(
        model=model,
        objectives=[pictures, Alpha(masked), prior, *config.terms.isometry()],
        weights={**weights, **config.terms.weights(), "alpha": config.alpha_weight},
        learning=learning_of(model, config.rates),
        densify=config.densify.limits(),
        body_frames=None,
        generator=generator,
        capture=masked,
    )


def _boxes(capture: MaskedCapture) -> dict[str, tuple[int, int, int, int]]:
    """Tight pixel box (x0, y0, x1, y1) of the mask, per training frame that shows somebody."""
    boxes = {}
    for frame in capture.train_frames:
        rows, columns = torch.nonzero(capture.human(frame), as_tuple=True)
        if len(rows):
            x0, x1, y0, y1 = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
            boxes[frame.name] = (int(x0), int(y0), int(x1), int(y1))
    return boxes
