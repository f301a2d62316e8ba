"""Method `evsplat`: discs in light, seen by a camera that integrates, beside an event camera.

Beyond `paper`: the blurry frame is the mean of renders over its exposure; events are compared at
any time and with their amplitude, by learned contrast thresholds; Gaussians have colours of their
own, the person's by how the surface is turned and where it stands; the person casts shadows.
"""

import logging
from dataclasses import dataclass
from functools import cache, partial
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.calibration import SensorEstimate
from evsplat.capture import (
    Frame,
    Policy,
    TrainingCapture,
    estimate_sensor,
    warn_of_linear_frames,
)
from evsplat.config import Above, AtLeast, AtMost, ReadIf, Within
from evsplat.errors import ConfigError
from evsplat.gaussians import FEATURE_DIM, GaussianSet
from evsplat.methods.background import background_without
from evsplat.methods.base import (
    Composition,
    HeldOut,
    Purpose,
    body_frames,
    refuse_masks,
    require_training_frames,
    semantic_bounds,
    start_of_randomness,
)
from evsplat.methods.dropped import EVSPLAT
from evsplat.methods.learning import Learning, Network, Rate, parameters_of, row_rates
from evsplat.methods.poses import PoseSettings, prepare_poses
from evsplat.methods.prefit import fit_scene
from evsplat.methods.settings import (
    WITH_EVENTS,
    WITH_WINDOWS,
    Densify,
    Nominal,
    NotNegative,
    Positive,
    Weight,
)
from evsplat.methods.starts import FittedScene, HumanStart, Surface, human_start, scene_start
from evsplat.models.discs import DiscModel
from evsplat.models.discs.fill import filled
from evsplat.models.discs.first_colours import first_colours
from evsplat.objectives import (
    DeformationPrior,
    EventChange,
    EventNoise,
    EventSensor,
    EventWindows,
    Exposure,
    HeldOutWindows,
    Objective,
    PosePrior,
    ReliefPrior,
    RenderedSemantics,
    minute_around,
    motion_px,
    renders_for,
)
from evsplat.render import LOW_PASS

logger = logging.getLogger(__name__)

CLOSED_SURFACE = Surface(opacity=0.88, width=0.8, flatness=0.3)
"""Flat discs that hide what is behind them from the first step on: light and shadow need that."""
LABEL = 2.0
"""Logits of the semantic attribute start at + and - this (A1)."""
UNKNOWN_THRESHOLD = 0.2
"""Contrast threshold to start from where neither the capture nor its frames tell one."""
CONSTANT_SHARE = 0.3
"""Share of the training before learning rates begin to fall."""
SCENE_NETWORK_RATE = 1e-3
"""Learning rate of the network of a random cube's colours."""
CHROMA_WEIGHT = 1.6
"""Weight of the mean absolute difference of Cb and Cr to the blurry frame, twice that of sRGB."""
RELIEF_WEIGHT = 3e-3
"""Weight of the roughness of the scene's relief."""
DEFORMATION_WEIGHT = 3e-3
"""Weight of the mean square of what the person's shape changes by, in centimetres."""
DEFORMATION_START = 1_500
"""Nominal iteration from which it changes."""
ERRORS_RATE = 0.3
"""Learning rate of the poses' errors as a share of that of the motion between exact key poses:
three splines add up to them, and all move at once."""
CLIP = 0.1
"""Largest gradient norm of the networks together."""

_LAMPS = ReadIf("lamps", "above 0", lambda lamps: lamps > 0)
_SEVERAL = ReadIf("most_renders", "3 or more", lambda most: most > 2)
_SHADING = ReadIf("shading", "true", lambda shading: bool(shading))


@dataclass(frozen=True)
class DiscRates:
    """Adam's learning rates at the start of training."""

    means: NotNegative = 6e-4
    """Centres, metres."""
    scales_log: NotNegative = 1e-2
    """Logarithms of the standard deviations."""
    opacity_logits: NotNegative = 0.05
    """Opacities before the sigmoid."""
    colour_logits: NotNegative = 1e-2
    """Colours before the sigmoid."""
    shade: NotNegative = 1e-3
    """Network of what poses do to the person's brightness."""
    deformation: NotNegative = 0.05
    """What the person's shape changes by in time where poses err, centimetres; 0 = nothing."""
    pose: NotNegative = 0.1
    """Pose residuals, units of the errors expected; lower where these exceed 0.05 radians."""
    shading: Annotated[float, AtLeast(0), _SHADING] = 6e-3
    """Light on the person."""
    shadow: Annotated[float, AtLeast(0), _LAMPS] = 2e-2
    """Places of the lamps and their shadows."""
    sensor: Annotated[float, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 1e-3
    """Logarithms of the contrast thresholds, and the events' clock."""
    final: Annotated[float, Above(0), AtMost(1)] = 0.1
    """Factor that every rate reaches at the end, exponentially from 0.3 of the training on."""


@dataclass(frozen=True)
class EvsplatConfig:
    """All settings of method `evsplat`."""

    DROPPED: ClassVar[dict[str, str]] = EVSPLAT

    policy: Policy = Policy()
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = 2_000
    """Training steps; all schedules stretch with it. Twice as many bring less than 0.2 dB. Without
    ``--iterations`` a run on exact poses ends earlier where little more is to come."""

    human: HumanStart = HumanStart(count=None, spacing_px=0.85)
    """Discs of the person at the start."""
    scene: FittedScene = FittedScene(
        kind="median_backdrop",
        cube_count=100_000,
        cube_half_side_m=None,
        cube_max_count=150_000,
        backdrop_stride_px=2,
        prefit_steps=300,
    )
    """Discs of the scene at the start; the median of a pixel is that of frames whose body is not
    near it."""
    fill: NotNegative = 0.001
    """How strongly neighbours along the surface, and the other side's, decide at the end of
    training about colours of the person that were little seen; 0 leaves them as they are."""
    densify: Densify = Densify(start=1_000, end=10_000, gradient=2e-4, max_human=10_000)
    """Growth and pruning."""

    width: Annotated[int, AtLeast(1)] = 64
    """Hidden width of the network of what poses do to the person's brightness."""
    shade_start: Nominal = 3_000
    """Nominal iteration at which that network is switched on; 15000: never."""
    pose_noise: NotNegative = 0.1
    """Standard deviation of the noise on the rotation matrices that it sees, in half of the
    steps."""
    shading: bool = True
    """The person's brightness depends on the surface's normal and place in the world."""
    lamps: Annotated[int, Within(0, 16)] = 4
    """Lamps at learned places, whose shadows of the person fall on the scene and which, with
    ``shading``, light the person; 0 = none."""
    self_shadow: Annotated[bool, _LAMPS, _SHADING] = True
    """Parts of the person that are nearer to a lamp shade others."""
    low_pass: Annotated[float, Above(0), AtMost(LOW_PASS)] = 0.1
    """Variance of the filter of a pixel, px^2; 3DGS and viewers of others take 0.3, the most."""

    px_per_render: Annotated[float, Above(0), _SEVERAL] = 3.0
    """Way of the body between neighbouring renders of an exposure, pixels."""
    most_renders: Annotated[int, AtLeast(1)] = 7
    """Upper bound of renders in an exposure, odd; 1 compares the sharp middle, as `paper` does."""

    event_weight: Weight = 0.2
    """Weight of the event term; 0 = without events."""
    event_term: Annotated[Literal["windows", "paper"], WITH_EVENTS] = "windows"
    """``windows``: changes between any two rendered times, with their amplitude. ``paper``:
    normalised changes between neighbouring frames' middles (its eq. 8-9)."""
    event_start: Annotated[Nominal, WITH_EVENTS] = 750
    """First nominal iteration of the event term."""
    event_eps: Annotated[float, Above(0), WITH_EVENTS, WITH_WINDOWS] = 0.004
    """Added to linear luminance: darker than this a sensor sees nothing."""
    event_reach: Annotated[float, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 0.5
    """Reach of windows before or after an exposure, in intervals of the training frames."""
    event_ramp_us: Annotated[int, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 100_000
    """Between two events of one polarity that lie at most so far apart, brightness is taken to
    change evenly instead of all at once at the second; 0: all at once."""
    event_hue_from: Annotated[Nominal, WITH_EVENTS, WITH_WINDOWS] = 15_000
    """Nominal iteration from which events pull at all channels alike, instead of as luminance has
    them, and leave the hue to the frames; 15000: never. 4500 takes tints off fast limbs."""
    event_noise_aware: Annotated[bool, WITH_EVENTS, WITH_WINDOWS] = True
    """Weigh differences by the sensor's background noise, and leave hot pixels out."""
    contrast_weight: Annotated[Weight, WITH_EVENTS, WITH_WINDOWS] = 1.0
    """Weight of the squared distance of the thresholds' logarithms from where they started."""
    clock: Annotated[Literal["auto", "always", "never"], WITH_EVENTS, WITH_WINDOWS] = "auto"
    """Learn by how much the events' clock is late, on top of the capture's own offset, starting at
    what training frames and events tell where that is over 4 ms and three standard errors.
    ``auto``: only there; ``always``: elsewhere from 0."""

    pose: PoseSettings = PoseSettings(
        smooth="auto",
        refine="auto",
        between=True,
        start=1_500,
        prior=1e-3,
        std_rad=None,
        std_m=None,
        events_of_held_out=False,
    )
    """Errors of the given poses."""

    l1_weight: Weight = 0.8
    """Weight of the mean absolute difference to the blurry frame, sRGB."""
    dssim_weight: Weight = 0.2
    """Weight of 1 - SSIM."""
    semantic_weight: Weight = 0.1
    """Weight of the rendered attribute's cross-entropy against the posed body's silhouette."""
    binarise_weight: Weight = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))
    """Weight of the mean of m (1 - m), which pushes the attribute m to 0 or 1."""
    semantic_band_px_at_256: Positive = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""

    rates: DiscRates = DiscRates()
    """Learning rates."""


def build(
    config: EvsplatConfig,
    capture: TrainingCapture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    purpose: Purpose = "train",
) -> Composition:
    """Put the method together for one capture."""
    require_training_frames(capture)
    refuse_masks(config.policy, "evsplat")
    fit = purpose == "train"
    generator = start_of_randomness(seed)
    poses = prepare_poses(config.pose, capture, fit=fit)
    background = _background(config, capture, poses.track) if fit else None
    frames = capture.train_frames
    times_us = [frame.mid_us for frame in frames]
    model = DiscModel(
        poses.track,
        times_us,
        _start(config, capture, poses.track, generator, background),
        width=config.width,
        shade_start=config.shade_start,
        pose_noise=config.pose_noise,
        low_pass=config.low_pass,
        shading=config.shading,
        lamps=config.lamps,
        self_shadow=config.self_shadow,
        scene_network=config.scene.kind == "random_cube",
        camera=None if config.scene.kind == "random_cube" else capture.camera(frames[0]),
        residual=poses.correction,
        residual_start=config.pose.start,
        deformation_start=DEFORMATION_START if config.rates.deformation else float("inf"),
    ).to(device)
    if fit:
        _fit_colours(config, capture, model, background)

    def renders(frame: Frame) -> int:
        motion = motion_px(capture.camera(frame), poses.track, frame)
        return renders_for(motion, config.px_per_render, config.most_renders)

    bounds = semantic_bounds(capture, poses.track, config.semantic_band_px_at_256)
    objectives: list[Objective] = [
        Exposure(capture, cache(renders), generator),
        RenderedSemantics(bounds),
    ]
    if poses.correction is not None:
        objectives.append(PosePrior())
    if config.rates.deformation:
        objectives.append(DeformationPrior())
    if model.relief is not None:
        objectives.append(ReliefPrior())
    windows = None
    if config.event_weight != 0.0 and capture.events is None:
        logger.warning(
            "%s: has no events; the blur of the frames alone tells what moved.", capture.path
        )
    elif config.event_weight != 0.0 and config.event_term == "paper":
        objectives.append(EventChange(capture, start=config.event_start))
    elif config.event_weight != 0.0:
        windows = _windows(config, capture, model, generator, device=device, purpose=purpose)
        objectives.append(windows)
    return Composition(
        model=model,
        objectives=objectives,
        weights={
            "l1": config.l1_weight,
            "chroma": CHROMA_WEIGHT,
            "dssim": config.dssim_weight,
            "semantic": config.semantic_weight,
            "binarise": config.binarise_weight,
            "pose_prior": config.pose.prior,
            "relief": RELIEF_WEIGHT,
            "deformation": DEFORMATION_WEIGHT,
            "event": config.event_weight,
            "contrast": config.contrast_weight,
        },
        learning=_learning(config.rates, model, poses.pace),
        densify=config.densify.limits(cube_max_count=config.scene.growth_limit),
        body_frames=body_frames(poses.track, times_us),
        generator=generator,
        held_out=None if windows is None else _held_out(config, capture, model, windows),
        watched=("l1", "dssim"),
        # Errors of poses, and shapes that change, are still learned where the loss hardly falls.
        ends_early=poses.correction is None or bool(poses.correction.exact),
        fill=partial(filled, model, capture, config.fill) if config.fill else None,
    )


def _background(
    config: EvsplatConfig, capture: TrainingCapture, track: BodyTrack
) -> Float[Tensor, "H W 3"] | None:
    """What a backdrop is to show; None where there is to be none."""
    if config.scene.kind != "median_backdrop" or not capture.is_static_camera:
        return None
    return background_without(capture, track, config.semantic_band_px_at_256)


def _fit_colours(
    config: EvsplatConfig,
    capture: TrainingCapture,
    model: DiscModel,
    background: Float[Tensor, "H W 3"] | None,
) -> None:
    """The scene as in ``background``, the person in the colours that the frames show."""
    gaussians = model.gaussians
    if background is not None:
        camera = capture.camera(capture.train_frames[0]).to(model.device)
        picture, steps = background.to(model.device), config.scene.prefit_steps
        fit_scene(gaussians, camera, picture, steps, low_pass=config.low_pass)
    colours = first_colours(model, capture)
    with torch.no_grad():
        gaussians.get_parameter(gaussians.colour)[gaussians.human, :3] = colours


def _start(
    config: EvsplatConfig,
    capture: TrainingCapture,
    track: BodyTrack,
    generator: torch.Generator,
    background: Float[Tensor, "H W 3"] | None,
) -> GaussianSet:
    """Discs on the body and behind it; random points get features for a network of their colour."""
    features = FEATURE_DIM if config.scene.kind == "random_cube" else None
    human = human_start(
        config.human, CLOSED_SURFACE, capture, track, generator, LABEL, feature_dim=features
    )
    scene, _ = scene_start(
        config.scene,
        capture,
        track,
        generator,
        -LABEL,
        feature_dim=features,
        background=background,
        goes_on=True,
    )
    return GaussianSet(human, scene)


def _learning(rates: DiscRates, model: DiscModel, pace: float) -> Learning:
    """Rates of discs, network, light, poses and sensor; ``pace`` is that of the poses' errors."""
    rows = row_rates(
        {
            "scales_log": rates.scales_log,
            "quaternions": 1e-3,
            "opacity_logits": rates.opacity_logits,
            model.gaussians.colour: rates.colour_logits,
        },
        means=rates.means,
        final=rates.final,
        means_final=rates.final,
        constant=CONSTANT_SHARE,
    )
    residual = model.residual
    parts = (
        (model.shade, rates.shade, True),
        (model.deformation, rates.deformation, False),
        (model.scene_colour, SCENE_NETWORK_RATE, True),
        (residual and residual.between, rates.pose, False),
        (residual and residual.errors, ERRORS_RATE * pace * rates.pose, False),
        (model.shading, rates.shading, False),
        (model.shadow, rates.shadow, False),
        (model.lamps, rates.shadow, False),
        (model.relief, rates.shadow, False),
        (model.sensor, rates.sensor, False),
    )
    networks = [
        Network(parameters, Rate(rate, rates.final, CONSTANT_SHARE), clipped=clipped)
        for part, rate, clipped in parts
        if (parameters := parameters_of(part))
    ]
    return Learning({"gaussians": rows}, networks, CLIP)


def _held_out(
    config: EvsplatConfig, capture: TrainingCapture, model: DiscModel, windows: EventWindows
) -> HeldOut | None:
    """Poses at held-out frames from the events around them, where that is asked for."""
    frames = list(capture.held_out_frames)
    if not config.pose.events_of_held_out or not frames:
        return None
    config.policy.require_held_out_events("pose.events_of_held_out")
    if model.residual is None:
        raise ConfigError(
            "pose.events_of_held_out is true, and nothing reads it: no residual of the poses of "
            f"{capture.path} is learned; pass --set pose.refine=always as well, or leave it out."
        )
    return HeldOut(
        frames,
        HeldOutWindows(windows, capture.train_frames),
        list(model.residual.parameters()),
        start=max(config.pose.start, config.event_start),
        every=max(1, len(capture.train_frames) // len(frames)),
    )


def _windows(
    config: EvsplatConfig,
    capture: TrainingCapture,
    model: DiscModel,
    generator: torch.Generator,
    *,
    device: torch.device | str,
    purpose: Purpose,
) -> EventWindows:
    """The event term, and the sensor that the model learns with it."""
    assert capture.events is not None
    # A loaded model brings its own.
    known, late_us = (UNKNOWN_THRESHOLD, UNKNOWN_THRESHOLD), None
    if purpose == "train":
        estimate = None
        if capture.contrast_threshold is None or config.clock != "never":
            estimate = estimate_sensor(capture)
            warn_of_linear_frames(capture, estimate)
        known = _thresholds(capture, estimate)
        late_us = _late_us(config, estimate)
        if not capture.events.has_polarity:
            logger.warning(
                "%s: its events have no polarity; the size of changes is compared with their "
                "number.", capture.path,
            )  # fmt: skip
    sensor = EventSensor(*known, late_us=late_us).to(device)
    model.sensor = sensor
    around_us = minute_around([frame.exposure_us for frame in capture.train_frames])
    noise = EventNoise(capture.events, during_us=around_us, aware=config.event_noise_aware)
    if purpose != "draw":
        noise.measure()
    return EventWindows(
        capture,
        sensor,
        generator,
        start=config.event_start,
        eps=config.event_eps,
        noise=noise,
        reach=config.event_reach,
        ramp_us=config.event_ramp_us,
        hue_from=config.event_hue_from,
    )


def _late_us(config: EvsplatConfig, estimate: SensorEstimate | None) -> float | None:
    """Start of the learned offset of the events' clock; None: not learned."""
    if config.clock == "never":
        return None
    if estimate is None or not estimate.clock.differs:
        return 0.0 if config.clock == "always" else None
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
