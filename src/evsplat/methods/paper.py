"""Method `paper`: the faithful reading of the paper, every reading a named setting.

The numbers A1 to A32 name the open points of the paper's text that a setting decides.
"""

import logging
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from evsplat.body import BodyTrack, body_box, load_body_track, silhouette, up_axis
from evsplat.capture import Capture
from evsplat.deform.human_scene import DeformConfig, HumanSceneModel, Semantics
from evsplat.deform.mlp import bfloat16_runs
from evsplat.errors import ConfigError, DataError
from evsplat.gaussians import BodyFrames, DensifyConfig, GaussianSet, Part
from evsplat.gaussians.initialise import (
    backdrop_depth,
    gaussians_at,
    median_backdrop,
    nearest_spacing,
    random_cube,
)
from evsplat.methods.composition import Composition
from evsplat.methods.config import OptimisationConfig, Weight
from evsplat.methods.prefit import fit_scene, fit_scene_colours, fit_skinning
from evsplat.methods.rates import learning_of
from evsplat.objectives import (
    EventChange,
    Isometry,
    Objective,
    PackedBounds,
    Photometric,
    RenderedSemantics,
    SkinningPrior,
)
from evsplat.objectives.perceptual import PerceptualName, make_perceptual

logger = logging.getLogger(__name__)

SURFACE_SAMPLES = 100_000
"""Body surface points drawn once for the skinning prior."""


@dataclass(frozen=True)
class HumanStartConfig:
    """How the person's Gaussians start (reference 1.2)."""

    count: int | None = None
    """Number of surface samples. 3DGS-Avatar takes 50,000; null = as many as ``spacing_px`` asks
    for, since a person of 4,000 pixels needs no 50,000 Gaussians."""
    spacing_px: float = 1.5
    """Mean distance of neighbouring samples on the screen when ``count`` is null."""
    max_count: int = 20_000
    """Upper bound of the automatic count."""
    opacity: float = 0.1
    """Opacity of every sample."""


@dataclass(frozen=True)
class SceneStartConfig:
    """How the scene's Gaussians start (A21: unsaid in the paper)."""

    kind: Literal["median_backdrop", "random_cube"] = "median_backdrop"
    """``random_cube``: as HUGS in the paper (2.9), needs far more steps. ``median_backdrop``: the
    temporal median of the training frames on a floor and a wall; static cameras only."""
    cube_count: int = 100_000
    """Points of the random cube."""
    cube_half_side_m: float | None = None
    """Half side of the cube; null = the larger of 2 m and 1.5 times the camera's distance."""
    cube_opacity: float = 0.1
    backdrop_stride_px: int = 2
    """The sheet has one Gaussian per square of this side."""
    backdrop_edge_share: float = 0.18
    """Share of all pixels, those of strongest gradient, that get a Gaussian of their own."""
    backdrop_opacity: float = 0.9
    backdrop_margin: float = 0.15
    """How far behind the deepest body point the wall stands, as a fraction of its depth."""
    prefit_steps: int = 300
    """Steps of fitting the sheet to the median before training proper."""


@dataclass(frozen=True)
class EventConfig:
    """The event term (paper eq. 8-9)."""

    weight: Weight = 0.1
    """w_ev, for the resolution-independent form ``sum / sqrt(N)`` (A15)."""
    start: float = 1_000
    """First nominal iteration; before, both renders show the same unfitted body (A16)."""
    floor: float = 0.03
    """Absolute floor of both norms (A16)."""
    eps: float = 1e-5
    """Added to linear luminance before the logarithm (A11)."""
    across_gaps: bool = False
    """Also pair training frames with held-out frames between them (A13)."""
    weight_by_activity: bool = True
    """Weigh pairs by their share of active pixels, within 0.25 to 4 of the median (A17)."""
    min_active: float = 0.001
    """Pairs with a smaller share of active pixels are left out (A16)."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of all other terms (A18)."""

    l1: Weight = 0.8
    dssim: Weight = 0.2
    """1 - SSIM of the whole frame, the better variant of A18; the base method has L1 alone."""
    perceptual: PerceptualName = "none"
    """``lpips_vgg`` is the paper's and needs its weights (see `evsplat doctor`); ``st_lpips`` runs
    with the extra `perceptual`."""
    perceptual_weight: Weight = 0.01
    skinning: Weight = ((0, 10.0), (1_000, 0.1))
    isometry_centers: Weight = 1.0
    isometry_covariances: Weight = 100.0
    semantic: Weight = 0.1
    binarise: Weight = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))


@dataclass(frozen=True)
class PaperConfig:
    """All settings of method `paper`."""

    semantics: Semantics = "rendered"
    """How the attribute learns: ``fixed``, ``ste`` (straight-through) or ``rendered`` (A2)."""
    semantic_start: float = 2.0
    """Labels start as logits +a and -a (A1)."""
    semantic_band_px_at_256: float = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""
    human: HumanStartConfig = field(default_factory=HumanStartConfig)
    scene: SceneStartConfig = field(default_factory=SceneStartConfig)
    deform: DeformConfig = field(default_factory=DeformConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    event: EventConfig = field(default_factory=EventConfig)
    isometry_refresh: int = 100
    """Steps between neighbour searches."""
    isometry_samples: int = 1_024
    """Gaussians whose isometry is looked at per step."""
    skinning_points: int = 1_024
    """Surface points per step of the skinning prior (1.6)."""
    skinning_prefit_steps: int = 2_000
    """Steps of fitting the skinning network alone before training proper. 2,000 bring its squared
    error against the body's weights to 0.03; with 400 it stays near 0.08 for good."""
    optimisation: OptimisationConfig = field(default_factory=OptimisationConfig)
    densify_human: DensifyConfig = field(default_factory=lambda: DensifyConfig(max_count=10_000))
    densify_scene: DensifyConfig | None = None
    """Limits of the scene. Null: 3DGS's for a random cube; none for the median backdrop, which has
    a Gaussian for every 2x2 pixels already and would only grow where the person passes."""


RANDOM_CUBE_DENSIFY = DensifyConfig(
    prune_opacity=0.005, prune_screen_px=None, prune_scale_m=None, max_count=150_000
)
"""3DGS's limits for a scene (A20): neither the 20-pixel nor the 0.05-opacity rule of a person."""


def compose(
    config: PaperConfig,
    capture: Capture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Model, objectives and limits for one capture.

    ``fit=False`` skips the cheap fits, for a model whose parameters are loaded afterwards.
    """
    build = Build.start(config, capture, seed, device=device, fit=fit)
    return build.composition(_observed(config, capture, build.track, device))


@dataclass(frozen=True)
class Build:
    """A model at its start, and what objectives are made from; shared by methods of this model."""

    config: PaperConfig
    capture: Capture
    track: BodyTrack
    """On the CPU, where silhouettes are drawn."""
    model: HumanSceneModel
    prior: SkinningPrior
    generator: torch.Generator

    @classmethod
    def start(
        cls,
        config: PaperConfig,
        capture: Capture,
        seed: int,
        *,
        device: torch.device | str,
        fit: bool,
    ) -> "Build":
        """Place the Gaussians, make the networks and run the cheap fits."""
        generator = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        track = load_body_track(capture)
        frames = capture.train_frames
        if not frames:
            raise DataError(f"{capture.path}: no frame has split 'train'; nothing to learn from.")
        times = [frame.mid_us for frame in frames]
        surface = track.body.sample_surface(SURFACE_SAMPLES, generator)

        human = _human_start(config, capture, track, generator)
        scene, colours = _scene_start(config, capture, track, generator)
        gaussians = GaussianSet(human, scene)
        model = HumanSceneModel(config.deform, config.semantics, track, times, gaussians)
        model = model.to(device)
        if config.deform.precision == "bfloat16" and not bfloat16_runs(model.box_low.device):
            logger.warning("This machine multiplies no bfloat16: the networks run in float32.")

        prior = SkinningPrior(surface.to(device), config.skinning_points)
        if fit:
            steps = config.scene.prefit_steps
            fit_skinning(model, prior, config.skinning_prefit_steps, generator)
            if config.scene.kind == "median_backdrop":
                camera = capture.camera(frames[0]).to(device)
                fit_scene_colours(model, camera, colours.to(device), steps, generator)
                fit_scene(model, camera, capture.median_background().to(device), steps)
        return cls(config, capture, track, model, prior, generator)

    def composition(self, observed: list[Objective]) -> Composition:
        """Everything together; ``observed`` are the objectives that compare with recorded data."""
        config, model = self.config, self.model
        objectives = [
            *observed,
            self.prior,
            Isometry(refresh=config.isometry_refresh, samples=config.isometry_samples),
        ]
        if config.semantics == "rendered":
            objectives.append(RenderedSemantics(_bounds(config, self.capture, self.track)))
        times = [frame.mid_us for frame in self.capture.train_frames]
        return Composition(
            model=model,
            objectives=objectives,
            weights={
                "l1": config.loss.l1,
                "dssim": config.loss.dssim,
                "perceptual": config.loss.perceptual_weight,
                "skinning": config.loss.skinning,
                "isometry_centers": config.loss.isometry_centers,
                "isometry_covariances": config.loss.isometry_covariances,
                "semantic": config.loss.semantic,
                "binarise": config.loss.binarise,
                "event": config.event.weight,
            },
            learning=learning_of(model, config.optimisation),
            densify={"human": config.densify_human, **_scene_limits(config)},
            body_frames=None
            if config.semantics == "fixed"
            else BodyFrames(model.track.body, model.track.bones(times)),
            generator=self.generator,
        )


def _scene_limits(config: PaperConfig) -> dict[Part, DensifyConfig]:
    if config.densify_scene is not None:
        return {"scene": config.densify_scene}
    return {"scene": RANDOM_CUBE_DENSIFY} if config.scene.kind == "random_cube" else {}


def _human_start(
    config: PaperConfig, capture: Capture, track: BodyTrack, generator: torch.Generator
) -> dict[str, Tensor]:
    count = config.human.count or _automatic_count(config.human, capture, track)
    points = track.body.sample_surface(count, generator).points
    scales = nearest_spacing(points)[:, None].repeat(1, 3)
    return gaussians_at(
        points,
        scales,
        opacity=config.human.opacity,
        semantic_logit=config.semantic_start,
    )


def _automatic_count(config: HumanStartConfig, capture: Capture, track: BodyTrack) -> int:
    """Surface samples so that neighbours lie ``spacing_px`` apart at the person's distance."""
    vertices = track.body.canonical_vertices()
    corners = vertices[track.body.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area_m2 = float(area.norm(dim=-1).sum() / 2)
    frame = capture.train_frames[len(capture.train_frames) // 2]
    camera = capture.camera(frame)
    _, depth = camera.project(track.vertices(frame.mid_us))
    pixels_per_metre = float(camera.K[0, 0] / depth.median().clamp_min(0.1))
    count = area_m2 * (pixels_per_metre / config.spacing_px) ** 2
    return int(min(max(count, 2_000), config.max_count))


def _scene_start(
    config: PaperConfig, capture: Capture, track: BodyTrack, generator: torch.Generator
) -> tuple[dict[str, Tensor], Tensor]:
    """Start values of the scene's Gaussians, and the colours they shall show."""
    start = config.scene
    frames = capture.train_frames
    camera = capture.camera(frames[0])
    _, translation = track.at(torch.tensor([frame.mid_us for frame in frames]))
    if start.kind == "random_cube":
        roots = track.body.rest_joints[0] + translation
        center = roots.mean(0)
        distance = float((center - camera.center()).norm())
        half_side = start.cube_half_side_m or max(2.0, 1.5 * distance)
        points, colours = random_cube(center, half_side, start.cube_count, generator)
        scales = nearest_spacing(points)[:, None].repeat(1, 3)
        opacity = start.cube_opacity
    else:
        if not capture.is_static_camera:
            raise ConfigError(
                f"{capture.path}: scene.kind is median_backdrop, which needs one static camera; "
                "this capture's camera moves. Pass --set scene.kind=random_cube."
            )
        body = torch.cat([track.vertices(frame.mid_us)[::7] for frame in frames])
        depth = backdrop_depth(camera, body, up=up_axis(track), margin=start.backdrop_margin)
        points, scales, colours = median_backdrop(
            camera,
            capture.median_background(),
            depth,
            stride=start.backdrop_stride_px,
            edge_points=int(start.backdrop_edge_share * camera.width * camera.height),
        )
        opacity = start.backdrop_opacity
    values = gaussians_at(
        points,
        scales,
        opacity=opacity,
        semantic_logit=-config.semantic_start,
        rgb_srgb=colours,
    )
    return values, colours


def _bounds(config: PaperConfig, capture: Capture, track: BodyTrack) -> dict[int, PackedBounds]:
    """Where the posed body says that the person is, by mid-exposure."""
    bounds = {}
    for frame in capture.train_frames:
        camera = capture.camera(frame)
        mask = silhouette(track.vertices(frame.mid_us), track.body.faces, camera)
        band = max(1, round(config.semantic_band_px_at_256 * camera.height / 256))
        bounds[frame.mid_us] = PackedBounds.of(mask.numpy(), band)
    return bounds


def _observed(
    config: PaperConfig, capture: Capture, track: BodyTrack, device: torch.device | str
) -> list[Objective]:
    """The paper's terms: pictures at mid-exposure, events between neighbouring frames."""
    boxes = {
        frame.name: box
        for frame in capture.train_frames
        if (box := body_box(track.vertices(frame.mid_us), capture.camera(frame))) is not None
    }
    perceptual = make_perceptual(config.loss.perceptual, device=device)
    dssim = config.loss.dssim != 0.0
    objectives: list[Objective] = [Photometric(capture, boxes, dssim=dssim, perceptual=perceptual)]
    if config.event.weight != 0.0:
        if capture.events is None:
            raise DataError(
                f"{capture.path}: method paper needs events, and capture.json names no event file; "
                "add one, or train without the term: --set event.weight=0."
            )
        objectives.append(
            EventChange(
                capture,
                start=config.event.start,
                floor=config.event.floor,
                eps=config.event.eps,
                across_gaps=config.event.across_gaps,
                weight_by_activity=config.event.weight_by_activity,
                min_active=config.event.min_active,
            )
        )
    return objectives
