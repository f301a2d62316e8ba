"""Method `hugs`: HUGS, a triplane person and a scene of its own, from pictures with masks.

Numbers of the form 2.1 are sections of the reference that docs/baselines.md quotes. Settings in
iterations are nominal ones of 15,000; the released code makes 14,999.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Policy, TrainingCapture, load_body_track
from evsplat.capture.masked import require_masks
from evsplat.gaussians import DensifyLimits, Part
from evsplat.gaussians.initialise import nearest_spacing
from evsplat.methods.base import (
    Composition,
    Purpose,
    require_training_frames,
    start_of_randomness,
)
from evsplat.methods.dropped import HUGS
from evsplat.methods.learning import Learning, Network, Rate, RowRate
from evsplat.methods.settings import NOMINAL_ITERATIONS, Densify, Positive, Weight
from evsplat.methods.starts import HumanStart, SceneStart, Surface, cube, human_start, scene_start
from evsplat.models.hugs import HugsModel, SphericalScene, TriplaneHuman
from evsplat.models.hugs.start import fit_to_body
from evsplat.objectives.hugs import HumanPicture, JointPicture, SkinningTarget
from evsplat.objectives.perceptual import PerceptualName, make_perceptual
from evsplat.ranges import AtLeast, ReadIf, Within

FIT_SAMPLES = 50_000
"""Points of the body's surface that the decoders start from."""
BACKDROP_SHARE = 0.1
"""Of the rate of scene centres where they start on the median backdrop. One camera sees no depth:
Adam makes a walk of its noise, and what walks in front of the person hides it."""
SKINNING_TURNS = 4
"""A training step decodes the skinning weights of one Gaussian in so many; released: of all."""
SKINNING_REFRESH = 50
"""Steps between look-ups of the body's weights; the released code does it at every step."""
FIT_BATCH = 1_024
"""Surface points per step of the fit."""
_PERCEPTUAL = ReadIf("perceptual", "not none", lambda name: name != "none")
FINEST = 256
"""Texels along a side of the released triplane."""


@dataclass(frozen=True)
class HugsConfig:
    """All settings of method `hugs`."""

    DROPPED: ClassVar[dict[str, str]] = HUGS

    policy: Policy = Policy(masks="given")
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""

    human: HumanStart = HumanStart(count=None, spacing_px=1.5)
    """Gaussians of the person at the start."""
    scene: SceneStart = SceneStart(
        kind="random_cube",
        cube_count=100_000,
        cube_half_side_m=None,
        cube_max_count=150_000,
        backdrop_stride_px=2,
    )
    """Gaussians of the scene at the start."""
    densify: Densify = Densify(start=3_000, end=15_000, gradient=2e-4, max_human=20_000)
    """Growth and pruning; of the scene from iteration 500 on. Released: at most 524,288 Gaussians
    of the person and 2,097,152 of the scene."""

    channels: Annotated[int, AtLeast(1)] = 32
    """Channels of each of the triplane's three planes."""
    resolution: Annotated[int, AtLeast(2)] | None = None
    """Texels along a side of them. Null: the power of two that brings a texel nearest to the size
    of a pixel at the person's distance, at most 256, which is the released number."""
    sh_degree: Annotated[int, Within(0, 3)] | None = None
    """Degree of the scene's spherical harmonics. Null: 3 as released, but 0 for one static camera,
    where a Gaussian is seen from one direction and all harmonics say the same."""
    fit_steps: Annotated[int, AtLeast(0)] = 1_000
    """Steps of the fit of triplane and decoders to the body before training. Released: 7,000."""

    l1_weight: Weight = 0.8
    """Weight of the mean absolute difference to the recorded picture, sRGB."""
    dssim_weight: Weight = 0.2
    """Weight of 1 - SSIM."""
    human_l1_weight: Weight = 0.8
    """Weight of the mean absolute difference on the person alone."""
    human_dssim_weight: Weight = 0.2
    """Weight of 1 - SSIM on the person alone."""
    skinning_weight: Weight = 1_000.0
    """Weight of the squared error of the decoded skinning weights."""
    perceptual: PerceptualName = "none"
    """``lpips_vgg`` is the released one and needs its weights; see `evsplat doctor`."""
    perceptual_weight: Annotated[Weight, _PERCEPTUAL] = 1.0
    """Weight of the perceptual distance of the joint picture and of the person alone."""

    rate_scale: Positive = 1.0
    """Factor on all learning rates, which are the released ones."""


def build(
    config: HugsConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    purpose: Purpose = "train",
) -> Composition:
    """Put the method together for one capture; a `DataError` where it has no masks."""
    require_training_frames(capture)
    require_masks(capture, "method hugs")
    generator = start_of_randomness(seed)
    track = load_body_track(capture)
    human, spacing = _human(config, capture, track, generator)
    # The scene's size, that rates and limits are relative to: the released code takes how far the
    # cameras are from each other, which is 0 for a static one; this reading works.
    _, extent = cube(config.scene, capture, track)
    scene = _scene(config, capture, track, generator)
    times_us = [frame.mid_us for frame in capture.train_frames]
    model = HugsModel(human, scene, track, times_us).to(device)
    if purpose == "train":
        fit_to_body(
            human,
            track.body.sample_surface(FIT_SAMPLES, generator).to(device),
            spacing,
            steps=config.fit_steps,
            batch=FIT_BATCH,
            generator=generator,
        )
    # Weights of a perceptual network need not be there to draw.
    name: PerceptualName = "none" if purpose == "draw" else config.perceptual
    perceptual = make_perceptual(name, device=device)
    return Composition(
        model=model,
        objectives=[
            JointPicture(capture, perceptual),
            HumanPicture(capture, perceptual),
            SkinningTarget(refresh=SKINNING_REFRESH),
        ],
        weights={
            "l1": config.l1_weight,
            "dssim": config.dssim_weight,
            "perceptual": config.perceptual_weight,
            "human_l1": config.human_l1_weight,
            "human_dssim": config.human_dssim_weight,
            "human_perceptual": config.perceptual_weight,
            "skinning": config.skinning_weight,
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
    points = human_start(config.human, Surface(), capture, track, generator, 0.0)["means"]
    vertices = track.body.canonical_vertices()
    low, high = vertices.amin(0), vertices.amax(0)
    # Of the cube that the planes cover: 1 m as released, more for a body that is larger.
    half_side = max(1.0, 1.1 * float((high - low).max()) / 2)
    human = TriplaneHuman(
        points,
        len(track.body.parents),
        channels=config.channels,
        resolution=config.resolution or _resolution(capture, track, half_side),
        center=(low + high) / 2,
        half_side=half_side,
        skinning_turns=SKINNING_TURNS,
    )
    return human, float(nearest_spacing(points).mean())


def _resolution(capture: TrainingCapture, track: BodyTrack, half_side_m: float) -> int:
    frame = capture.train_frames[len(capture.train_frames) // 2]
    camera = capture.camera(frame)
    depth = float(camera.project(track.vertices(frame.mid_us))[1].median().clamp_min(0.1))
    pixel_m = depth / float(camera.K[0, 0])
    return min(FINEST, 2 ** max(4, round(math.log2(2 * half_side_m / pixel_m))))


def _scene(
    config: HugsConfig, capture: TrainingCapture, track: BodyTrack, generator: torch.Generator
) -> SphericalScene:
    values, colours = scene_start(config.scene, capture, track, generator, 0.0)
    seen = _seen(values["means"], capture)
    degree = config.sh_degree
    if degree is None:
        degree = 0 if capture.is_static_camera else 3
    return SphericalScene({k: v[seen] for k, v in values.items()}, colours[seen], degree)


def _seen(points: Float[Tensor, "N 3"], capture: TrainingCapture) -> Tensor:
    """Points in view of a training camera, or near it: no other one would ever learn anything."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for camera in capture.recorders():
        pixels, depth = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        seen |= (depth > 0.01) & ((pixels / size - 0.5).abs() < 0.6).all(-1)
    return seen


def _limits(config: HugsConfig, extent: float) -> dict[Part, DensifyLimits]:
    """Released limits; a median backdrop would only grow in front of the person."""
    human = DensifyLimits(
        start=config.densify.start,
        end=config.densify.end,
        every=600,
        gradient=config.densify.gradient,
        split_above_m=0.01,
        prune_opacity=0.005,
        prune_after=0,
        prune_screen_px=20,
        prune_scale_m=0.1,
        max_count=config.densify.max_human,
    )
    if config.scene.growth_limit is None:
        return {"human": human}
    scene = replace(
        human,
        start=500,
        every=100,
        split_above_m=0.01 * extent,
        prune_after=3_000,
        prune_screen_px=None,
        prune_scale_m=None,
        max_count=config.scene.growth_limit,
    )
    return {"human": human, "scene": scene}


def _learning(model: HugsModel, config: HugsConfig, extent: float) -> Learning:
    """Released rates; centres fall to a tenth, as after half of the released 30,000."""
    scale, human = config.rate_scale, model.human
    start = 1.6e-4 * scale * extent
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
                "means": RowRate(Rate(3.2e-4 * scale, final=0.1)),
                "scales_log": RowRate(Rate(0.0)),
            },
            "scene": {
                "means": RowRate(Rate(start, final=0.1)),
                "scales_log": RowRate(Rate(5e-3 * scale)),
                "quaternions": RowRate(Rate(1e-3 * scale)),
                "opacity_logits": RowRate(Rate(0.05 * scale)),
                "constant": RowRate(Rate(2.5e-3 * scale)),
                "directional": RowRate(Rate(2.5e-3 / 20 * scale)),
            },
        },
        networks=[
            Network(decoders, Rate(1e-3 * scale)),
            Network(list(human.skinning.parameters()), Rate(1e-4 * scale)),
            Network([model.turns, model.shifts], Rate(1e-4 * scale)),
        ],
    )
