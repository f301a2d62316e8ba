"""Methods `avatar3dgs` and `avatar3dgs_semantic`: 3DGS-Avatar, and 3DGS-Avatar* of the paper.

The first is the person alone on black, learned from masked pictures. The second has the paper's
semantic attribute, whole pictures and no masks: one set of Gaussians, person and scene alike, whose
attribute starts at 0.5. As a logit that is a probability of 0.62, so that everything begins as the
person and is dragged along by the skeleton until its label is learned (A1). Numbers of the form 1.5
are sections of the reference that docs/baselines.md quotes.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch

from evsplat.body import body_box
from evsplat.capture import Policy, TrainingCapture, load_body_track
from evsplat.capture.masked import MaskedCapture
from evsplat.gaussians import GaussianSet
from evsplat.methods.avatar_parts import (
    RELEASED_RATES,
    SURFACE_SAMPLES,
    AvatarRates,
    AvatarTerms,
    Networks,
    avatar,
    learning_of,
)
from evsplat.methods.base import (
    Composition,
    Purpose,
    body_frames,
    refuse_masks,
    require_training_frames,
    semantic_bounds,
    start_of_randomness,
)
from evsplat.methods.dropped import AVATAR, AVATAR_SEMANTIC
from evsplat.methods.settings import NOMINAL_ITERATIONS, Densify, Share, Weight
from evsplat.methods.starts import (
    HumanStart,
    SceneStart,
    Surface,
    as_person,
    human_start,
    no_gaussians,
    scene_start,
)
from evsplat.objectives import Alpha, RenderedSemantics
from evsplat.pictures.box import mask_box
from evsplat.ranges import Above, AtLeast

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
    surface = track.body.sample_surface(SURFACE_SAMPLES, generator)
    person = human_start(config.human, Surface(), masked, track, generator, SURELY_PERSON)
    model, (pictures, *priors), weights = avatar(
        masked,
        track,
        GaussianSet(person, no_gaussians()),
        surface,
        generator,
        lambda frame: mask_box(masked.human(frame)),
        semantics="fixed",
        released=True,
        scene_direction_dropout=0.0,
        networks=config.networks,
        terms=config.terms,
        l1=config.l1_weight,
        dssim=config.dssim_weight,
        device=device,
        purpose=purpose,
    )
    return Composition(
        model=model,
        objectives=[pictures, Alpha(masked), *priors],
        weights={**weights, "alpha": config.alpha_weight},
        learning=learning_of(model, config.rates),
        densify=config.densify.limits(),
        body_frames=None,
        generator=generator,
        capture=masked,
    )


@dataclass(frozen=True)
class AvatarSemanticConfig:
    """All settings of method `avatar3dgs_semantic`."""

    DROPPED: ClassVar[dict[str, str]] = AVATAR_SEMANTIC

    policy: Policy = Policy()
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""

    human: HumanStart = HumanStart(count=None, spacing_px=1.5)
    """Gaussians of the person at the start."""
    scene: SceneStart = SceneStart(
        kind="median_backdrop",
        cube_count=100_000,
        cube_half_side_m=None,
        cube_max_count=150_000,
        backdrop_stride_px=2,
    )
    """Places of the scene's Gaussians at the start; nothing is fitted to them before training."""
    densify: Densify = Densify(start=1_000, end=10_000, gradient=2e-4, max_human=60_000)
    """Growth and pruning."""
    networks: Networks = Networks(pose_start=5_000)
    """Networks that move and colour the person."""
    scene_direction_dropout: Share = 0.5
    """How often a training step hides the view direction from the scene's colour; a static camera
    cannot teach it (A10)."""

    semantic_start: float = 0.5
    """Logit of all Gaussians."""
    semantic_band_px_at_256: Annotated[float, Above(0)] = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""

    l1_weight: Weight = 1.0
    """Weight of the mean absolute difference to the recorded picture, sRGB."""
    dssim_weight: Weight = 0.0
    """Weight of 1 - SSIM."""
    terms: AvatarTerms = AvatarTerms(perceptual="available")
    """Other terms of the loss."""
    semantic_weight: Weight = 0.1
    """Weight of the rendered attribute's cross-entropy against the posed body's silhouette."""
    binarise_weight: Weight = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))
    """Weight of the mean of m (1 - m), which pushes the attribute m to 0 or 1."""

    rates: AvatarRates = RELEASED_RATES
    """Learning rates."""


def build_semantic(
    config: AvatarSemanticConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    purpose: Purpose = "train",
) -> Composition:
    """Put the method together for one capture.

    The scene's points follow the root bone and lie in their place at the middle training frame.
    """
    require_training_frames(capture)
    refuse_masks(config.policy, "avatar3dgs_semantic")
    generator, label = start_of_randomness(seed), config.semantic_start
    track = load_body_track(capture)
    times_us = [frame.mid_us for frame in capture.train_frames]
    surface = track.body.sample_surface(SURFACE_SAMPLES, generator)
    person = human_start(config.human, Surface(), capture, track, generator, label)
    scene, _ = scene_start(config.scene, capture, track, generator, label)
    scene = as_person(scene, track, times_us[len(times_us) // 2])
    everything = {name: torch.cat([person[name], scene[name]]) for name in person}
    model, (pictures, *priors), weights = avatar(
        capture,
        track,
        GaussianSet(everything, no_gaussians()),
        surface,
        generator,
        lambda frame: body_box(track.vertices(frame.mid_us), capture.camera(frame)),
        semantics="rendered",
        released=True,
        scene_direction_dropout=config.scene_direction_dropout,
        networks=config.networks,
        terms=config.terms,
        l1=config.l1_weight,
        dssim=config.dssim_weight,
        device=device,
        purpose=purpose,
    )
    bounds = semantic_bounds(capture, track, config.semantic_band_px_at_256)
    return Composition(
        model=model,
        objectives=[pictures, RenderedSemantics(bounds), *priors],
        weights={
            **weights,
            "semantic": config.semantic_weight,
            "binarise": config.binarise_weight,
        },
        learning=learning_of(model, config.rates),
        densify=config.densify.limits(cube_max_count=config.scene.growth_limit),
        body_frames=body_frames(track, times_us),
        generator=generator,
    )
