"""Method `hugs`: HUGS, a triplane person and a scene of its own, from pictures with masks.

Numbers of the form 2.1 are sections of the reference that docs/baselines.md quotes. Settings in
iterations are nominal ones of 15,000; the released code makes 14,999.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack, load_body_track
from evsplat.capture import Policy, TrainingCapture
from evsplat.capture.masked import require_masks
from evsplat.errors import DataError
from evsplat.gaussians import DensifyConfig, Part
from evsplat.gaussians.initialise import nearest_spacing
from evsplat.hugs.human import TriplaneHuman
from evsplat.hugs.losses import HumanPicture, JointPicture, Perceptual, SkinningTarget
from evsplat.hugs.model import HugsModel
from evsplat.hugs.scene import SphericalScene
from evsplat.hugs.start import fit_to_body
from evsplat.methods.composition import Composition
from evsplat.methods.config import NOMINAL_ITERATIONS, Weight
from evsplat.methods.rates import Learning, Network, Rate, RowRate
from evsplat.methods.starts import (
    HumanStartConfig,
    SceneStartConfig,
    human_start,
    scene_start,
)
from evsplat.objectives import Objective
from evsplat.objectives.perceptual import PerceptualName, make_perceptual

FIT_SAMPLES = 50_000
"""Points of the body's surface that the decoders start from."""
BACKDROP_SHARE = 0.1
"""Of the rate of scene centres where they start on the median backdrop. One camera sees no depth:
Adam makes a walk of its noise, and what walks in front of the person hides it."""
FINEST = 256
"""Texels along a side of the released triplane."""


@dataclass(frozen=True)
class TriplaneConfig:
    """The person's features."""

    channels: int = 32
    """Of each of the three planes."""
    resolution: int | None = None
    """Texels along a side. Null: the power of two that brings a texel nearest to the size of a
    pixel at the person's distance, at most 256, which is the released number."""
    half_side_m: float | None = None
    """Of the cube that it covers, about the middle of the canonical body. Null: 1 m as released,
    more for a body that is larger."""


@dataclass(frozen=True)
class FitConfig:
    """Fit of triplane and decoders to the body before training. Released: 7,000 steps of all."""

    steps: int = 1_000
    batch: int = 1_024
    """Surface points per step."""


@dataclass(frozen=True)
class HugsSceneConfig(SceneStartConfig):
    """The scene's start and colour."""

    kind: Literal["median_backdrop", "random_cube"] = "random_cube"
    """``random_cube``: as in the paper's comparison (2.9). ``median_backdrop``: the temporal median
    of the training frames on a floor and a wall; static cameras only, and far fewer steps."""
    sh_degree: int | None = None
    """Of the spherical harmonics. Null: 3 as released, but 0 for one static camera, where a
    Gaussian is seen from one direction and all harmonics say the same."""


@dataclass(frozen=True)
class HugsLossConfig:
    """Weights of the terms (2.4)."""

    l1: Weight = 0.8
    dssim: Weight = 0.2
    human_l1: Weight = 0.8
    human_dssim: Weight = 0.2
    skinning: Weight = 1_000.0
    perceptual: PerceptualName = "none"
    """``lpips_vgg`` is the released one and needs its weights; see `evsplat doctor`."""
    perceptual_weight: Weight = 1.0
    """Of the joint picture and of the person alone."""


@dataclass(frozen=True)
class HugsRates:
    """Adam's learning rates (2.5)."""

    human_means: float = 3.2e-4
    """Centres, metres; a tenth of it at the end, as after half of the released 30,000."""
    triplane: float = 1e-3
    """The triplane, its appearance and its geometry decoder."""
    skinning: float = 1e-4
    pose: float = 1e-4
    """Per-frame rotations and translations."""
    scene_means: float = 1.6e-4
    """Times the scene's extent; a tenth of it at the end."""
    constant: float = 2.5e-3
    """Constant spherical harmonic; a twentieth of it for the others."""
    opacity_logits: float = 0.05
    scales_log: float = 5e-3
    quaternions: float = 1e-3


@dataclass(frozen=True)
class HugsOptimisation:
    """How long and how fast."""

    iterations: int = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""
    rates: HugsRates = field(default_factory=HugsRates)


@dataclass(frozen=True)
class HugsConfig:
    """All settings of method `hugs`."""

    policy: Policy = field(default_factory=lambda: Policy(masks="given"))
    """What training may see of what is held out."""
    human: HumanStartConfig = field(default_factory=HumanStartConfig)
    triplane: TriplaneConfig = field(default_factory=TriplaneConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    scene: HugsSceneConfig = field(default_factory=HugsSceneConfig)
    loss: HugsLossConfig = field(default_factory=HugsLossConfig)
    skinning_turns: int = 4
    """A training step decodes the skinning weights of one Gaussian in so many, in turns; 1 = of
    all, as released."""
    skinning_refresh: int = 50
    """Steps between look-ups of the body's weights; the released code does it at every step."""
    optimisation: HugsOptimisation = field(default_factory=HugsOptimisation)
    densify_human: DensifyConfig = field(
        default_factory=lambda: DensifyConfig(
            start=3_000, end=15_000, every=600, split_above_m=0.01, prune_opacity=0.005,
            prune_after=0, prune_screen_px=20, prune_scale_m=0.1, max_count=20_000,
        )
    )  # fmt: skip
    """Released: at most 524,288."""
    densify_scene: DensifyConfig | None = None
    """Null: for a random cube 3DGS's, with a hundredth of the scene's extent as the size above
    which Gaussians are split, and at most 150,000 of them (released: 2,097,152); none for a median
    backdrop, which would only grow where the person passes, and in front of it."""


def compose(
    config: HugsConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Put the method together for one capture; see `evsplat.methods.paper.compose`.

    A `DataError` where the capture has no masks.
    """
    if not capture.train_frames:
        raise DataError(f"{capture.path}: no frame has split 'train'; nothing to learn from.")
    require_masks(capture, "method hugs")
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    track = load_body_track(capture)
    human, spacing = _human(config, capture, track, generator)
    extent = _extent(config, capture, track)
    scene = _scene(config, capture, track, generator)
    times_us = [frame.mid_us for frame in capture.train_frames]
    model = HugsModel(human, scene, track, times_us).to(device)
    if fit:
        fit_to_body(
            human,
            track.body.sample_surface(FIT_SAMPLES, generator).to(device),
            spacing,
            steps=config.fit.steps,
            batch=config.fit.batch,
            generator=generator,
        )
    metric = make_perceptual(config.loss.perceptual, device=device)
    perceptual = None if metric is None else Perceptual(metric)
    objectives: list[Objective] = [
        JointPicture(capture, perceptual),
        HumanPicture(capture, perceptual),
        SkinningTarget(refresh=config.skinning_refresh),
    ]
    loss = config.loss
    return Composition(
        model=model,
        objectives=objectives,
        weights={
            "l1": loss.l1,
            "dssim": loss.dssim,
            "perceptual": loss.perceptual_weight,
            "human_l1": loss.human_l1,
            "human_dssim": loss.human_dssim,
            "human_perceptual": loss.perceptual_weight,
            "skinning": loss.skinning,
        },
        learning=_learning(model, config, extent),
        densify=_limits(config, extent),
        body_frames=None,
        generator=generator,
    )


def _human(
    config: HugsConfig, capture: TrainingCapture, track: BodyTrack, generator: torch.Generator
) -> tuple[TriplaneHuman, float]:
    """The person at its start, and the mean distance of neighbouring Gaussians, metres."""
    points = human_start(config.human, capture, track, generator, 0.0)["means"]
    vertices = track.body.canonical_vertices()
    low, high = vertices.amin(0), vertices.amax(0)
    half_side = config.triplane.half_side_m or max(1.0, 1.1 * float((high - low).max()) / 2)
    human = TriplaneHuman(
        points,
        len(track.body.parents),
        channels=config.triplane.channels,
        resolution=config.triplane.resolution or _resolution(capture, track, half_side),
        center=(low + high) / 2,
        half_side=half_side,
        skinning_turns=config.skinning_turns,
    )
    return human, float(nearest_spacing(points).mean())


def _resolution(capture: TrainingCapture, track: BodyTrack, half_side_m: float) -> int:
    frame = capture.train_frames[len(capture.train_frames) // 2]
    camera = capture.camera(frame)
    depth = float(camera.project(track.vertices(frame.mid_us))[1].median().clamp_min(0.1))
    pixel_m = depth / float(camera.K[0, 0])
    return min(FINEST, 2 ** max(4, round(math.log2(2 * half_side_m / pixel_m))))


def _extent(config: HugsConfig, capture: TrainingCapture, track: BodyTrack) -> float:
    """The scene's size, metres, that its rates and limits are relative to.

    The released code takes how far the cameras are from each other, which is 0 for a static one;
    half the side of the random cube is the reading that works (2.9).
    """
    frames = capture.train_frames
    centers = torch.stack([capture.camera(frame).center() for frame in frames])
    if config.scene.cube_half_side_m:
        return config.scene.cube_half_side_m
    translation = track.at(torch.tensor([frame.mid_us for frame in frames]))[1]
    middle = (track.body.rest_joints[0] + translation).mean(0)
    return max(2.0, 1.5 * float((middle - centers[0]).norm()))


def _scene(
    config: HugsConfig, capture: TrainingCapture, track: BodyTrack, generator: torch.Generator
) -> SphericalScene:
    scene = config.scene
    values, colours = scene_start(scene, capture, track, generator, 0.0)
    seen = _seen(values["means"], capture)
    degree = scene.sh_degree
    if degree is None:
        degree = 0 if capture.is_static_camera else 3
    return SphericalScene({k: v[seen] for k, v in values.items()}, colours[seen], degree)


def _seen(points: Float[Tensor, "N 3"], capture: TrainingCapture) -> Tensor:
    """Points in view of a training camera, or near it: no other one would ever learn anything."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    cameras = [capture.camera(frame) for frame in capture.train_frames]
    for camera in cameras[:1] if capture.is_static_camera else cameras:
        pixels, depth = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        seen |= (depth > 0.01) & ((pixels / size - 0.5).abs() < 0.6).all(-1)
    return seen


def _limits(config: HugsConfig, extent: float) -> dict[Part, DensifyConfig]:
    human, scene = config.densify_human, config.densify_scene
    still = config.scene.kind == "median_backdrop"
    if scene is None and still:
        return {"human": human}
    if scene is None:
        scene = DensifyConfig(
            start=500, end=15_000, every=100, split_above_m=0.01 * extent, prune_opacity=0.005,
            prune_screen_px=None, prune_scale_m=None, max_count=150_000,
        )  # fmt: skip
    return {"human": human, "scene": scene}


def _learning(model: HugsModel, config: HugsConfig, extent: float) -> Learning:
    rates = config.optimisation.rates
    human = model.human
    falling = 0.1
    start = rates.scene_means * extent
    if config.scene.kind == "median_backdrop":
        start *= BACKDROP_SHARE
    decoders = [
        *human.triplane.parameters(),
        *human.appearance.parameters(),
        *human.geometry.parameters(),
    ]
    return Learning(
        rows={
            "human": {
                "means": RowRate(Rate(rates.human_means, falling)),
                "scales_log": RowRate(Rate(0.0)),
            },
            "scene": {
                "means": RowRate(Rate(start, falling)),
                "scales_log": RowRate(Rate(rates.scales_log)),
                "quaternions": RowRate(Rate(rates.quaternions)),
                "opacity_logits": RowRate(Rate(rates.opacity_logits)),
                "constant": RowRate(Rate(rates.constant)),
                "directional": RowRate(Rate(rates.constant / 20)),
            },
        },
        networks=[
            Network(decoders, Rate(rates.triplane)),
            Network(list(human.skinning.parameters()), Rate(rates.skinning)),
            Network([model.turns, model.shifts], Rate(rates.pose)),
        ],
    )
