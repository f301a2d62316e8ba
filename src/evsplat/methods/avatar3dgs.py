"""Method `avatar3dgs`: 3DGS-Avatar, the person alone on black, learned from masked pictures.

Numbers of the form 1.5 are sections of the reference that docs/baselines.md quotes.
"""

from dataclasses import dataclass, field, fields

import torch

from evsplat.capture import Policy, TrainingCapture
from evsplat.capture.masked import MaskedCapture
from evsplat.deform.human_scene import DeformConfig
from evsplat.errors import ConfigError
from evsplat.gaussians import DensifyConfig, GaussianSet
from evsplat.methods.build import Build, Ground, PersonConfig, PersonLossConfig
from evsplat.methods.composition import Composition
from evsplat.methods.config import LearningRates, OptimisationConfig, Weight
from evsplat.methods.starts import human_start, no_gaussians
from evsplat.objectives import Alpha, Objective, Photometric
from evsplat.objectives.perceptual import PerceptualChoice, choose_perceptual

SURELY_PERSON = 20.0
"""Logit whose sigmoid is 1 to the last bit of float32: nothing moves it, and its channel of a
picture is the alpha picture."""
SCENE_SETTINGS = ("scene_view_dependent", "scene_direction_dropout", "shadow_lights")
"""Settings of `DeformConfig` that mean nothing without a scene."""


@dataclass(frozen=True)
class AvatarLossConfig(PersonLossConfig):
    """Weights of the terms (reference 1.9)."""

    l1: Weight = 1.0
    dssim: Weight = 0.0
    perceptual: PerceptualChoice = "available"
    """``lpips_vgg`` is the released one; ``available`` takes it where its weights are, else
    ``st_lpips`` where that is installed, and the term has the name of what it is."""
    alpha: Weight = 0.1
    """L1 between the alpha picture and the mask."""


def avatar_rates() -> LearningRates:
    """Learning rates of 3DGS-Avatar (reference 1.10)."""
    return LearningRates(features=1e-3, constant=0.0, gaussians_final=1.0)


def avatar_deform() -> DeformConfig:
    """Networks of 3DGS-Avatar as released (reference 1.3 to 1.8)."""
    return DeformConfig(
        non_rigid_last_std=None,
        skinning_turns=1,
        view_noise_symmetric=False,
        pose_correction_start=5_000,
        unseen_frames="released",
    )


@dataclass(frozen=True)
class AvatarConfig(PersonConfig):
    """All settings of method `avatar3dgs`."""

    policy: Policy = field(default_factory=lambda: Policy(masks="given"))
    deform: DeformConfig = field(default_factory=avatar_deform)
    loss: AvatarLossConfig = field(default_factory=AvatarLossConfig)
    optimisation: OptimisationConfig = field(
        default_factory=lambda: OptimisationConfig(rates=avatar_rates())
    )
    densify_human: DensifyConfig = field(default_factory=DensifyConfig)


def compose(
    config: AvatarConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Put the method together for one capture; see `evsplat.methods.paper.compose`.

    A `DataError` where the capture has no masks, a `ConfigError` where a setting of a scene is set.
    """
    _refuse_scene(config.deform)
    masked = MaskedCapture(capture, "method avatar3dgs")
    ground = Ground.of(masked, seed)
    person = human_start(config.human, masked, ground.track, ground.generator, SURELY_PERSON)
    gaussians = GaussianSet(person, no_gaussians())
    build = Build.of(config, ground, gaussians, "fixed", device=device, fit=fit)

    name, perceptual = choose_perceptual(config.loss.perceptual, device=device)
    dssim = config.loss.dssim != 0.0
    observed: list[Objective] = [
        Photometric(
            masked,
            _boxes(masked) if perceptual else {},
            dssim=dssim,
            perceptual=perceptual,
            perceptual_term=name,
        ),
        Alpha(masked),
    ]
    weights: dict[str, Weight] = {"alpha": config.loss.alpha}
    if perceptual:
        weights[name] = config.loss.perceptual_weight
    return build.composition(
        config,
        config.loss,
        observed,
        weights=weights,
        densify={},
        capture=masked,
    )


def _refuse_scene(deform: DeformConfig) -> None:
    defaults = {f.name: f.default for f in fields(DeformConfig)}
    for name in SCENE_SETTINGS:
        if getattr(deform, name) != defaults[name]:
            raise ConfigError(
                f"deform.{name} is {getattr(deform, name)}, but method avatar3dgs has no scene; "
                "leave that setting out."
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
