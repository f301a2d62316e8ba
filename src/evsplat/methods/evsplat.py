"""Method `evsplat`: the paper's model seen by a camera that integrates, in light that falls on it.

What it adds to `paper`: the blurry frame is the mean of renders over its exposure; events are
compared at any time and with their amplitude, by learned contrast thresholds; the person's colour
depends on how the surface is turned and where it stands; the person casts shadows on the scene.
"""

import logging
from dataclasses import dataclass, field, replace
from typing import Literal

import torch

from evsplat.calibration import SensorEstimate, estimate_from_capture
from evsplat.capture import TrainingCapture
from evsplat.deform.human_scene import DeformConfig
from evsplat.methods.build import Build
from evsplat.methods.composition import Composition, HeldOut
from evsplat.methods.config import LearningRates, OptimisationConfig, Weight
from evsplat.methods.paper import (
    EventConfig,
    LossConfig,
    PaperConfig,
    build_model,
    composition,
    paper_events,
)
from evsplat.methods.poses import PoseConfig, prepare_poses
from evsplat.methods.starts import HumanStartConfig
from evsplat.objectives import (
    EventNoise,
    EventSensor,
    EventWindows,
    Exposure,
    HeldOutWindows,
    Objective,
    PosePrior,
    motion_px,
    renders_for,
)

logger = logging.getLogger(__name__)

UNKNOWN_THRESHOLD = 0.2
"""Contrast threshold to start from where neither the capture nor its frames tell one."""


@dataclass(frozen=True)
class ExposureConfig:
    """The blur of a frame."""

    px_per_render: float = 3.0
    """How far, in pixels, the body moves between neighbouring renders."""
    most_renders: int = 7
    """Upper bound of renders in an exposure, odd; 1 compares the sharp middle, as `paper` does."""


@dataclass(frozen=True)
class WindowConfig:
    """Event windows."""

    start: float = 750
    """First nominal iteration."""
    eps: float = 0.004
    """Added to linear luminance: darker than this a sensor sees nothing."""
    contrast_weight: float = 1.0
    """Weight of the squared distance of the thresholds' logarithms from where they started."""
    reach: float = 0.5
    """How far before or after an exposure windows reach, in intervals of the training frames."""
    noise_aware: bool = True
    """Weigh differences by the sensor's background noise, and leave hot pixels out."""
    begun_us: int = 100_000
    """Between two events of one polarity that lie at most so far apart, brightness is taken to
    change evenly instead of all at once at the second; 0: all at once."""
    clock: Literal["auto", "always", "never"] = "auto"
    """Learn by how much the events' clock is late, on top of the capture's own offset, starting at
    what training frames and events tell where that is over 4 ms and three standard errors.
    ``auto``: only there; ``always``: elsewhere from 0."""


@dataclass(frozen=True)
class EvsplatConfig(PaperConfig):
    """All settings of method `evsplat`; those of `paper` that it shares keep their names."""

    loss: LossConfig = field(
        default_factory=lambda: LossConfig(isometry_centers=0.0, isometry_covariances=0.0)
    )
    """Without isometry: discs that hang on the body's own weights stretch with it already."""
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    event_term: Literal["windows", "paper"] = "windows"
    """``paper`` compares normalised changes between neighbouring frames' middles (its eq. 8-9) in
    place of windows."""
    event: EventConfig = field(default_factory=lambda: EventConfig(weight=0.2))
    human: HumanStartConfig = field(
        default_factory=lambda: HumanStartConfig(
            spacing_px=0.85, opacity=0.88, width=0.8, flatness=0.3
        )
    )
    """A closed surface of flat discs from the first step on: light and shadow need one."""
    deform: DeformConfig = field(
        default_factory=lambda: DeformConfig(
            networks_once=True,
            skinning="surface",
            human_colour="own",
            shading=True,
            shadow_lights=4,
            self_shadow=True,
            low_pass=0.1,
        )
    )
    optimisation: OptimisationConfig = field(
        default_factory=lambda: OptimisationConfig(
            rates=LearningRates(means=3e-4, features=1e-2, pose_correction=0.1), human_start=0
        )
    )
    pose: PoseConfig = field(default_factory=PoseConfig)


def compose(
    config: EvsplatConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Put the method together for one capture; see `evsplat.methods.paper.compose`."""
    poses = prepare_poses(config.pose, capture, tell=fit)
    if poses.spline is not None:
        deform = replace(config.deform, pose_correction_start=config.pose.start)
        config = replace(config, deform=deform)
    build = build_model(
        config,
        capture,
        seed,
        device=device,
        fit=fit,
        track=poses.track,
        pose_spline=poses.spline,
    )
    renders = {
        frame.name: renders_for(
            motion_px(capture.camera(frame), build.ground.track, frame),
            config.exposure.px_per_render,
            config.exposure.most_renders,
        )
        for frame in capture.train_frames
    }
    windows = held_out = None
    if config.event.weight != 0.0 and config.event_term == "windows" and capture.events is not None:
        windows = _windows(config.windows, capture, build, device=device, fit=fit)
        held_out = _held_out(config, capture, build, windows)
    observed: list[Objective] = [Exposure(capture, renders, build.ground.generator)]
    weights: dict[str, Weight] = {}
    if poses.spline is not None:
        observed.append(PosePrior(poses.priced_us))
        weights["pose_prior"] = config.pose.prior
    if config.event.weight != 0.0:
        weights["event"] = config.event.weight
        if capture.events is None:
            logger.warning(
                "%s: has no events; the blur of the frames alone tells what moved.", capture.path
            )
        elif windows is None:
            observed.append(paper_events(config.event, capture))
        else:
            observed.append(windows)
            weights["contrast"] = config.windows.contrast_weight
    return composition(config, build, observed, weights, held_out)


def _held_out(
    config: EvsplatConfig, capture: TrainingCapture, build: Build, windows: EventWindows
) -> HeldOut | None:
    """What events around held-out frames teach of their poses, where that is asked for."""
    model = build.model
    frames = list(capture.held_out_frames)
    if not config.pose.events_of_held_out or model.pose_spline is None or not frames:
        return None
    config.policy.require_held_out_events("pose.events_of_held_out")
    return HeldOut(
        frames,
        HeldOutWindows(windows, capture.train_frames),
        [model.rotation_residuals, model.translation_residuals],
        start=max(config.pose.start, config.windows.start),
        every=max(1, len(capture.train_frames) // len(frames)),
    )


def _windows(
    windows: WindowConfig,
    capture: TrainingCapture,
    build: Build,
    *,
    device: torch.device | str,
    fit: bool,
) -> EventWindows:
    """The event term, and the sensor that the model learns with it."""
    assert capture.events is not None
    # A loaded model brings its own.
    known, late_us = (UNKNOWN_THRESHOLD, UNKNOWN_THRESHOLD), None
    if fit:
        estimate = None
        if capture.contrast_threshold is None or windows.clock != "never":
            estimate = estimate_from_capture(capture)
        known = _thresholds(capture, estimate)
        late_us = _late_us(windows, estimate)
    build.model.sensor = EventSensor(*known, late_us=late_us).to(device)
    if fit and not capture.events.has_polarity:
        logger.warning(
            "%s: its events have no polarity; the size of changes is compared with their number.",
            capture.path,
        )
    return EventWindows(
        capture,
        build.model.sensor,
        build.ground.generator,
        start=windows.start,
        eps=windows.eps,
        noise=EventNoise(capture.events, aware=windows.noise_aware),
        reach=windows.reach,
        begun_us=windows.begun_us,
    )


def _late_us(windows: WindowConfig, estimate: SensorEstimate | None) -> float | None:
    """From where the offset of the events' clock is learned; None: not at all."""
    if windows.clock == "never":
        return None
    if estimate is None or not estimate.clock.differs:
        return 0.0 if windows.clock == "always" else None
    late_ms = estimate.clock.lag_us / 1000
    logger.info("events lag the frames by %.1f ms; the offset of their clock is learned", late_ms)
    return estimate.clock.lag_us


def _thresholds(capture: TrainingCapture, estimate: SensorEstimate | None) -> tuple[float, float]:
    """C+ and C-: the capture's, or those at which training frames and events agree best."""
    if capture.contrast_threshold is not None:
        return capture.contrast_threshold
    if estimate is None or estimate.thresholds is None:
        logger.warning(
            "%s: contrast thresholds are neither given nor to be found from frames and events; "
            "starting from %g.", capture.path, UNKNOWN_THRESHOLD,
        )  # fmt: skip
        return UNKNOWN_THRESHOLD, UNKNOWN_THRESHOLD
    found = estimate.thresholds
    logger.info("contrast thresholds found: C+ %.3f, C- %.3f", found.plus, found.minus)
    return found.plus, found.minus
