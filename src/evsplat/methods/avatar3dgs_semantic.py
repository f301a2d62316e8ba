"""Method `avatar3dgs_semantic`: 3DGS-Avatar* of the paper's tables.

3DGS-Avatar with the paper's semantic attribute, on whole pictures and without masks: one set of
Gaussians, person and scene alike, whose attribute starts at 0.5. As a logit that is a probability
of 0.62, so everything begins as the person and is dragged along by the skeleton until its label is
learned (A1).
"""

from dataclasses import dataclass, field

import torch

from evsplat.capture import TrainingCapture
from evsplat.deform.human_scene import DeformConfig
from evsplat.gaussians import DensifyConfig, GaussianSet
from evsplat.methods.avatar3dgs import avatar_deform, avatar_rates
from evsplat.methods.build import Build, Ground
from evsplat.methods.composition import Composition
from evsplat.methods.config import OptimisationConfig
from evsplat.methods.paper import EventConfig, LossConfig, PaperConfig, composition, observed
from evsplat.methods.starts import (
    FittedSceneConfig,
    as_person,
    human_start,
    no_gaussians,
    scene_start,
)


@dataclass(frozen=True)
class AvatarSemanticConfig(PaperConfig):
    """All settings of method `avatar3dgs_semantic`: those of `paper`, set as 3DGS-Avatar's."""

    semantic_start: float = 0.5
    """Logit of all Gaussians."""
    scene: FittedSceneConfig = field(default_factory=lambda: FittedSceneConfig(prefit_steps=0))
    """Where the scene's points start; nothing is fitted to them before training."""
    deform: DeformConfig = field(default_factory=avatar_deform)
    loss: LossConfig = field(
        default_factory=lambda: LossConfig(l1=1.0, dssim=0.0, perceptual="available")
    )
    event: EventConfig = field(default_factory=lambda: EventConfig(weight=0.0))
    optimisation: OptimisationConfig = field(
        default_factory=lambda: OptimisationConfig(rates=avatar_rates())
    )
    densify_human: DensifyConfig = field(default_factory=DensifyConfig)


def compose(
    config: AvatarSemanticConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Put the method together for one capture; see `evsplat.methods.paper.compose`.

    The scene's points follow the root bone and lie in their place at the middle training frame.
    """
    ground = Ground.of(capture, seed)
    label, generator = config.semantic_start, ground.generator
    person = human_start(config.human, capture, ground.track, generator, label)
    scene, _ = scene_start(config.scene, capture, ground.track, generator, label)
    scene = as_person(scene, ground.track, ground.times_us[len(ground.times_us) // 2])
    all_of_it = {name: torch.cat([person[name], scene[name]]) for name in person}
    gaussians = GaussianSet(all_of_it, no_gaussians())
    build = Build.of(config, ground, gaussians, config.semantics, device=device, fit=fit)
    return composition(config, build, *observed(config, capture, ground.track, device))
