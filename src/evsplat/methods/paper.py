"""Method `paper`: the faithful reading of the paper, every reading a named setting.

The numbers A1 to A32 name the open points of the paper's text that a setting decides.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import body_box
from evsplat.capture import Policy, TrainingCapture, load_body_track
from evsplat.errors import DataError
from evsplat.gaussians import GaussianSet
from evsplat.methods.avatar_parts import (
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
from evsplat.methods.dropped import PAPER
from evsplat.methods.prefit import fit_scene, fit_scene_colours
from evsplat.methods.settings import (
    NOMINAL_ITERATIONS,
    WITH_EVENTS,
    Densify,
    Nominal,
    Share,
    Weight,
)
from evsplat.methods.starts import (
    FROM_MEDIAN,
    FittedScene,
    HumanStart,
    Surface,
    human_start,
    scene_start,
)
from evsplat.models.paper import PaperModel, Semantics
from evsplat.objectives import EventChange, Objective, RenderedSemantics
from evsplat.ranges import Above, AtLeast, ReadIf

_RENDERED = ReadIf("semantics", "rendered", lambda semantics: semantics == "rendered")


@dataclass(frozen=True)
class PaperConfig:
    """All settings of method `paper`."""

    DROPPED: ClassVar[dict[str, str]] = PAPER

    policy: Policy = Policy()
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""

    human: HumanStart = HumanStart(count=None, spacing_px=1.5)
    """Gaussians of the person at the start."""
    scene: FittedScene = FROM_MEDIAN
    """Gaussians of the scene at the start."""
    densify: Densify = Densify(start=1_000, end=10_000, gradient=2e-4, max_human=10_000)
    """Growth and pruning."""
    networks: Networks = Networks()
    """Networks that move and colour the person."""
    scene_direction_dropout: Share = 0.5
    """How often a training step hides the view direction from the scene's colour; a static camera
    cannot teach it (A10)."""

    semantics: Semantics = "rendered"
    """Teacher of the attribute (A2): ``fixed``, none; ``ste``, straight-through placement;
    ``rendered``, the posed body's silhouette."""
    semantic_start: float = 2.0
    """Labels start as logits +a and -a (A1)."""
    semantic_band_px_at_256: Annotated[float, Above(0), _RENDERED] = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""

    event_weight: Weight = 0.1
    """w_ev, for the resolution-independent form ``sum / sqrt(N)`` (A15)."""
    event_start: Annotated[Nominal, WITH_EVENTS] = 1_000
    """First nominal iteration; before, both renders show the same unfitted body (A16)."""
    event_floor: Annotated[float, AtLeast(0), WITH_EVENTS] = 0.03
    """Absolute floor of both norms (A16)."""
    event_eps: Annotated[float, Above(0), WITH_EVENTS] = 1e-5
    """Added to linear luminance before the logarithm (A11)."""
    event_weight_by_activity: Annotated[bool, WITH_EVENTS] = True
    """Weigh pairs by their share of active pixels, within 0.25 to 4 of the median (A17)."""
    event_min_active: Annotated[float, AtLeast(0), WITH_EVENTS] = 0.001
    """Pairs with a smaller share of active pixels are left out (A16)."""

    l1_weight: Weight = 0.8
    """Weight of the mean absolute difference to the recorded picture, sRGB (A18)."""
    dssim_weight: Weight = 0.2
    """Weight of 1 - SSIM, the better variant of A18; the base method has L1 alone."""
    terms: AvatarTerms = AvatarTerms()
    """Other terms of the loss (A18)."""
    semantic_weight: Annotated[Weight, _RENDERED] = 0.1
    """Weight of the rendered attribute's cross-entropy against the posed body's silhouette."""
    binarise_weight: Annotated[Weight, _RENDERED] = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))
    """Weight of the mean of m (1 - m), which pushes the attribute m to 0 or 1."""

    rates: AvatarRates = AvatarRates()
    """Learning rates."""


def build(
    config: PaperConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    purpose: Purpose = "train",
) -> Composition:
    """Put the method together for one capture."""
    require_training_frames(capture)
    refuse_masks(config.policy, "paper")
    # First of all, since it refuses a capture without events, and the fits below take minutes.
    events = [_events(config, capture)] if config.event_weight != 0.0 else []
    generator = start_of_randomness(seed)
    track = load_body_track(capture)
    times_us = [frame.mid_us for frame in capture.train_frames]
    label = config.semantic_start
    surface = track.body.sample_surface(SURFACE_SAMPLES, generator)
    human = human_start(config.human, Surface(), capture, track, generator, label)
    scene, colours = scene_start(config.scene, capture, track, generator, -label)
    model, (pictures, *priors), weights = avatar(
        capture,
        track,
        GaussianSet(human, scene),
        surface,
        generator,
        lambda frame: body_box(track.vertices(frame.mid_us), capture.camera(frame)),
        semantics=config.semantics,
        released=False,
        scene_direction_dropout=config.scene_direction_dropout,
        networks=config.networks,
        terms=config.terms,
        l1=config.l1_weight,
        dssim=config.dssim_weight,
        device=device,
        purpose=purpose,
    )
    if purpose == "train" and config.scene.kind == "median_backdrop":
        _fit_backdrop(model, capture, colours, config.scene.prefit_steps, generator)

    objectives: list[Objective] = [pictures, *events]
    if config.semantics == "rendered":
        bounds = semantic_bounds(capture, track, config.semantic_band_px_at_256)
        objectives.append(RenderedSemantics(bounds))
    return Composition(
        model=model,
        objectives=[*objectives, *priors],
        weights={
            **weights,
            "event": config.event_weight,
            "semantic": config.semantic_weight,
            "binarise": config.binarise_weight,
        },
        learning=learning_of(model, config.rates),
        densify=config.densify.limits(cube_max_count=config.scene.growth_limit),
        body_frames=None if config.semantics == "fixed" else body_frames(track, times_us),
        generator=generator,
    )


def _fit_backdrop(
    model: PaperModel,
    capture: TrainingCapture,
    colours: Float[Tensor, "S 3"],
    steps: int,
    generator: torch.Generator,
) -> None:
    """The scene as in the median of the frames; its network first learns the ``colours`` alone."""
    gaussians, network, device = model.gaussians, model.scene_colour, model.device
    camera = capture.camera(capture.train_frames[0]).to(device)
    picture = capture.median_background().to(device)
    fit_scene_colours(network, gaussians, camera, colours.to(device), steps, generator)
    fit_scene(gaussians, camera, picture, steps, low_pass=model.low_pass, network=network)


def _events(config: PaperConfig, capture: TrainingCapture) -> EventChange:
    """The paper's event term (eq. 8-9)."""
    if capture.events is None:
        raise DataError(
            f"{capture.path}: method paper needs events, and capture.json names no event file; "
            "add one, or train without the term: --set event_weight=0."
        )
    return EventChange(
        capture,
        start=config.event_start,
        floor=config.event_floor,
        eps=config.event_eps,
        weight_by_activity=config.event_weight_by_activity,
        min_active=config.event_min_active,
    )
