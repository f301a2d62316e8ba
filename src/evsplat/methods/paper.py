"""Method `paper`: the faithful reading of the paper, every reading a named setting.

The numbers A1 to A32 name the open points of the paper's text that a setting decides.
"""

from dataclasses import dataclass, field

import torch

from evsplat.body import BodyTrack, body_box, silhouette
from evsplat.capture import TrainingCapture
from evsplat.deform.human_scene import Semantics
from evsplat.deform.pose_spline import PoseSpline
from evsplat.errors import DataError
from evsplat.gaussians import DensifyConfig, GaussianSet, Part
from evsplat.methods.build import Build, Ground, PersonConfig, PersonLossConfig
from evsplat.methods.composition import Composition, HeldOut
from evsplat.methods.config import Weight
from evsplat.methods.prefit import fit_scene, fit_scene_colours
from evsplat.methods.starts import FittedSceneConfig, human_start, scene_start
from evsplat.objectives import (
    EventChange,
    Objective,
    PackedBounds,
    Photometric,
    RenderedSemantics,
)
from evsplat.objectives.perceptual import PerceptualChoice, choose_perceptual


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
    weight_by_activity: bool = True
    """Weigh pairs by their share of active pixels, within 0.25 to 4 of the median (A17)."""
    min_active: float = 0.001
    """Pairs with a smaller share of active pixels are left out (A16)."""


@dataclass(frozen=True)
class LossConfig(PersonLossConfig):
    """Weights of all other terms (A18)."""

    perceptual: PerceptualChoice = "none"
    """``lpips_vgg`` is the paper's and needs its weights (see `evsplat doctor`); ``st_lpips`` runs
    with the extra `perceptual`; ``available`` takes the first of them that runs. The term has the
    name of what it is."""
    semantic: Weight = 0.1
    binarise: Weight = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))


@dataclass(frozen=True)
class PaperConfig(PersonConfig):
    """All settings of method `paper`."""

    semantics: Semantics = "rendered"
    """How the attribute learns (A2): ``fixed``; ``ste`` (straight-through); ``rendered``, by the
    posed body's silhouette."""
    semantic_start: float = 2.0
    """Labels start as logits +a and -a (A1)."""
    semantic_band_px_at_256: float = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""
    scene: FittedSceneConfig = field(default_factory=FittedSceneConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    event: EventConfig = field(default_factory=EventConfig)
    densify_scene: DensifyConfig | None = None
    """Limits of the scene. Null: 3DGS's for a random cube; none for the median backdrop, which has
    a Gaussian for every 2x2 pixels already and would only grow where the person passes."""


RANDOM_CUBE_DENSIFY = DensifyConfig(
    prune_opacity=0.005, prune_screen_px=None, prune_scale_m=None, max_count=150_000
)
"""3DGS's limits for a scene (A20): neither the 20-pixel nor the 0.05-opacity rule of a person."""


def compose(
    config: PaperConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Model, objectives and limits for one capture.

    ``fit=False`` skips the cheap fits, for a model whose parameters are loaded afterwards.
    """
    build = build_model(config, capture, seed, device=device, fit=fit)
    return composition(config, build, *observed(config, capture, build.ground.track, device))


def build_model(
    config: PaperConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str,
    fit: bool,
    track: BodyTrack | None = None,
    pose_spline: PoseSpline | None = None,
) -> Build:
    """Person and scene at their start; with ``fit`` after the cheap fits.

    ``track`` is the motion where it is not the capture's as given.
    """
    ground = Ground.of(capture, seed, track)
    label = config.semantic_start
    human = human_start(config.human, capture, ground.track, ground.generator, label)
    scene, colours = scene_start(config.scene, capture, ground.track, ground.generator, -label)
    gaussians = GaussianSet(human, scene)
    build = Build.of(
        config,
        ground,
        gaussians,
        config.semantics,
        device=device,
        fit=fit,
        pose_spline=pose_spline,
    )
    if fit and config.scene.kind == "median_backdrop":
        steps = config.scene.prefit_steps
        camera = capture.camera(capture.train_frames[0]).to(device)
        fit_scene_colours(build.model, camera, colours.to(device), steps, ground.generator)
        fit_scene(build.model, camera, capture.median_background().to(device), steps)
    return build


def composition(
    config: PaperConfig,
    build: Build,
    observed: list[Objective],
    weights: dict[str, Weight],
    held_out: HeldOut | None = None,
) -> Composition:
    """Everything together.

    ``observed`` are the objectives that compare with recorded data, ``weights`` those of their
    terms beside ``l1`` and ``dssim``; ``held_out`` is what held-out frames teach.
    """
    ground = build.ground
    if config.semantics == "rendered":
        bounds = _bounds(config, ground.capture, ground.track)
        observed = [*observed, RenderedSemantics(bounds)]
    return build.composition(
        config,
        config.loss,
        observed,
        weights={
            **weights,
            "semantic": config.loss.semantic,
            "binarise": config.loss.binarise,
        },
        densify=_scene_limits(config),
        held_out=held_out,
    )


def _scene_limits(config: PaperConfig) -> dict[Part, DensifyConfig]:
    if config.densify_scene is not None:
        return {"scene": config.densify_scene}
    return {"scene": RANDOM_CUBE_DENSIFY} if config.scene.kind == "random_cube" else {}


def _bounds(
    config: PaperConfig, capture: TrainingCapture, track: BodyTrack
) -> dict[int, PackedBounds]:
    """Where the posed body says that the person is, by mid-exposure."""
    bounds = {}
    for frame in capture.train_frames:
        camera = capture.camera(frame)
        mask = silhouette(track.vertices(frame.mid_us), track.body.faces, camera)
        band = max(1, round(config.semantic_band_px_at_256 * camera.height / 256))
        bounds[frame.mid_us] = PackedBounds.of(mask.numpy(), band)
    return bounds


def observed(
    config: PaperConfig, capture: TrainingCapture, track: BodyTrack, device: torch.device | str
) -> tuple[list[Objective], dict[str, Weight]]:
    """The paper's terms: pictures at mid-exposure, events between neighbouring frames.

    Weights are those of the terms beside ``l1`` and ``dssim``.
    """
    boxes = {
        frame.name: box
        for frame in capture.train_frames
        if (box := body_box(track.vertices(frame.mid_us), capture.camera(frame))) is not None
    }
    name, perceptual = choose_perceptual(config.loss.perceptual, device=device)
    dssim = config.loss.dssim != 0.0
    objectives: list[Objective] = [
        Photometric(capture, boxes, dssim=dssim, perceptual=perceptual, perceptual_term=name)
    ]
    weights: dict[str, Weight] = {}
    if perceptual is not None:
        weights[name] = config.loss.perceptual_weight
    if config.event.weight != 0.0:
        if capture.events is None:
            raise DataError(
                f"{capture.path}: method paper needs events, and capture.json names no event file; "
                "add one, or train without the term: --set event.weight=0."
            )
        objectives.append(paper_events(config.event, capture))
        weights["event"] = config.event.weight
    return objectives, weights


def paper_events(config: EventConfig, capture: TrainingCapture) -> EventChange:
    """The paper's event term (eq. 8-9)."""
    return EventChange(
        capture,
        start=config.start,
        floor=config.floor,
        eps=config.eps,
        weight_by_activity=config.weight_by_activity,
        min_active=config.min_active,
    )
