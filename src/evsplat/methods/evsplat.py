"""Method `evsplat`: discs in light, seen by a camera that integrates, beside an event camera.

Beyond `paper`: the blurry frame is the mean of renders over its exposure; events are compared at
any time and with their amplitude, by learned contrast thresholds; Gaussians have colours of their
own, the person's by how the surface is turned and where it stands; the person casts shadows.
"""

import logging
from functools import cache, partial

import torch
from torch import Tensor

from evsplat.body import BodyTrack, up_axis
from evsplat.capture import Camera, Frame, TrainingCapture
from evsplat.errors import ConfigError
from evsplat.gaussians import FEATURE_DIM, GaussianSet
from evsplat.gaussians.depth_order import set_apart
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
from evsplat.methods.evsplat_settings import DiscRates, EvsplatConfig
from evsplat.methods.furniture import furnished
from evsplat.methods.learning import Learning, Network, Rate, parameters_of, row_rates
from evsplat.methods.moving_background import middle_view, moving_backdrop, require_one_side
from evsplat.methods.poses import Poses, prepare_poses
from evsplat.methods.prefit import fit_scene
from evsplat.methods.room import find_room
from evsplat.methods.sensor import event_windows
from evsplat.methods.starts import Backdrop, Surface, human_start, places, scene_start
from evsplat.models.discs import DiscModel
from evsplat.models.discs.fill import filled
from evsplat.models.discs.first_colours import first_colours
from evsplat.models.discs.outskirts import outskirts
from evsplat.models.discs.pictured import pictured
from evsplat.models.discs.solid import solid
from evsplat.models.seen import Seen
from evsplat.models.solid_scene import SolidScene
from evsplat.objectives import (
    DeformationPrior,
    EventChange,
    EventWindows,
    Exposure,
    HeldOutWindows,
    Objective,
    PosePrior,
    ReliefPrior,
    RenderedSemantics,
    motion_px,
    renders_for,
    sweep_px,
)

logger = logging.getLogger(__name__)

CLOSED_SURFACE = Surface(opacity=0.88, width=0.8, flatness=0.3, fewest=250)
"""Flat discs that hide what is behind them from the first step on: light and shadow need that."""
LABEL = 2.0
"""Logits of the semantic attribute start at + and - this (A1)."""
CONSTANT_SHARE = 0.3
"""Share of the training before learning rates begin to fall."""
SCENE_NETWORK_RATE = 1e-3
"""Learning rate of the network of a random cube's colours."""
CHROMA_WEIGHT = 1.6
"""Weight of the mean absolute difference of Cb and Cr to the blurry frame, twice that of sRGB."""
RELIEF_WEIGHT = 3e-3
"""Weight of the roughness of the scene's relief."""
DEFORMATION_WEIGHT = 3e-3
"""Weight of the mean square of what the person's shape changes by, in centimetres; where poses are
expected to err by much, in units that are larger in proportion (`FREEST`)."""
DEFORMATION_START = 1_500
"""Nominal iteration from which it changes."""
FREEST = 4.0
"""Bound of how much more freely it does so where poses are expected to err by over 0.05 radians:
the shape moves limbs to where steps of the poses' errors, which are small then, don't."""
ERRORS_RATE = 0.3
"""Learning rate of the poses' errors as a share of that of the motion between exact key poses:
three splines add up to them, and all move at once."""
CLIP = 0.1
"""Largest gradient norm of the networks together."""


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
    background = _background(config, capture, poses.track, fit=fit)
    frames = capture.train_frames
    still = config.scene.kind != "random_cube" and capture.is_static_camera
    recording = capture.camera(frames[0]) if still else None
    gaussians = _start(config, capture, poses.track, generator, background)
    if recording is not None:
        set_apart(gaussians, recording)
    model = _model(config, capture, poses, gaussians, recording).to(device)
    if fit:
        _fit_colours(config, capture, model, background)
    objectives = _of_pictures(config, capture, poses.track, generator) + _priors(model)
    windows, thresholds_found = None, True
    asks_events = config.event_weight != 0.0 and capture.events is not None
    if fit and config.event_weight != 0.0 and not asks_events:
        logger.info(
            "%s: has no events; the blur of the frames alone tells what moved.", capture.path
        )
    if asks_events and config.event_term == "paper":
        objectives.append(EventChange(capture, start=config.event_start))
    elif asks_events:
        windows, thresholds_found = event_windows(
            config, capture, model, generator, device=device, purpose=purpose
        )
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
        body_frames=body_frames(poses.track, [frame.mid_us for frame in frames]),
        generator=generator,
        held_out=None if windows is None else _held_out(config, capture, model, windows),
        # Errors of poses, and shapes that change, are still learned where the loss hardly falls.
        watched=("l1", "dssim") if poses.correction is None or poses.correction.exact else (),
        recording=recording,
        fill=partial(_filled, model, capture, config) if config.fill else None,
        thresholds_found=thresholds_found,
    )


def _model(
    config: EvsplatConfig,
    capture: TrainingCapture,
    poses: Poses,
    gaussians: GaussianSet,
    recording: Camera | None,
) -> DiscModel:
    """Person and scene at their start; ``recording`` is the camera where it stands still."""
    changes = poses.may_err and config.rates.deformation > 0
    return DiscModel(
        poses.track,
        [frame.mid_us for frame in capture.train_frames],
        gaussians,
        width=config.width,
        shade_start=config.shade_start,
        pose_noise=config.pose_noise,
        low_pass=config.low_pass,
        shading=config.shading,
        lamps=config.lamps,
        self_shadow=config.self_shadow,
        scene_network=config.scene.kind == "random_cube",
        camera=recording,
        residual=poses.correction,
        residual_start=config.pose.start,
        deformation_start=DEFORMATION_START if changes else None,
        deformation_freedom=min(1 / poses.pace, FREEST),
    )


def _of_pictures(
    config: EvsplatConfig,
    capture: TrainingCapture,
    track: BodyTrack,
    generator: torch.Generator,
) -> list[Objective]:
    """Objectives that look at the blurry frames, and at where the body is in them."""

    def renders(frame: Frame) -> int:
        ends = capture.cameras_at(frame.camera, frame.exposure_us)
        motion = max(each(ends, track, frame) for each in (motion_px, sweep_px))
        return renders_for(motion, config.px_per_render, config.most_renders)

    bounds = semantic_bounds(capture, track, config.semantic_band_px_at_256)
    return [Exposure(capture, cache(renders), generator), RenderedSemantics(bounds)]


def _priors(model: DiscModel) -> list[Objective]:
    """One for each part of the model that frames alone would not hold."""
    parts = {
        PosePrior: model.residual,
        DeformationPrior: model.deformation,
        ReliefPrior: model.relief,
    }
    return [prior() for prior, part in parts.items() if part is not None]


def _filled(
    model: DiscModel, capture: TrainingCapture, config: EvsplatConfig, seen: Seen
) -> tuple[dict[str, Tensor], SolidScene | None]:
    """What the end of training decides of the person, and of the scene that one camera saw."""
    decided = filled(model, capture, config.fill, seen)
    several = len({frame.camera for frame in capture.train_frames}) > 1
    if config.scene.kind == "random_cube" or several:
        return decided, None
    cameras = [camera.to(model.device) for camera in capture.recorders()]
    gaussians = model.gaussians
    name = f"gaussians.{gaussians.colour}"
    colours = decided.get(name, gaussians.get_parameter(gaussians.colour)).detach().clone()
    of_scene = pictured(gaussians, cameras[0], model.low_pass) if len(cameras) == 1 else None
    of_scene = outskirts(gaussians, cameras, model.low_pass, of_scene)
    colours[gaussians.scene] = of_scene.logit()
    return decided | {name: colours}, solid(gaussians, cameras, model.low_pass, of_scene)


def _background(
    config: EvsplatConfig, capture: TrainingCapture, track: BodyTrack, *, fit: bool
) -> Backdrop | None:
    """What a backdrop is to show; None where there is to be none, or a still one's is loaded."""
    if config.scene.kind != "median_backdrop":
        return None
    if not capture.is_static_camera:
        require_one_side(capture)
        if fit:
            return moving_backdrop(capture, track, config.semantic_band_px_at_256)
        camera = middle_view(capture)
        return Backdrop(camera, torch.zeros(camera.height, camera.width, 3))
    if not fit:
        return None
    picture = background_without(capture, track, config.semantic_band_px_at_256)
    camera = capture.camera(capture.train_frames[0])
    body = places(capture, track)
    room = find_room(camera, picture, body, up_axis(track))
    shares = None if room is None else furnished(camera, picture, room, body)
    return Backdrop(camera, picture, depth_shares=shares, room=room)


def _fit_colours(
    config: EvsplatConfig,
    capture: TrainingCapture,
    model: DiscModel,
    background: Backdrop | None,
) -> None:
    """The scene as in ``background``, the person in the colours that the frames show."""
    gaussians = model.gaussians
    if background is not None:
        camera = background.camera.to(model.device)
        picture, steps = background.picture.to(model.device), config.scene.prefit_steps
        fit_scene(gaussians, camera, picture, steps, low_pass=config.low_pass)
    colours = first_colours(model, capture)
    with torch.no_grad():
        gaussians.get_parameter(gaussians.colour)[gaussians.human, :3] = colours


def _start(
    config: EvsplatConfig,
    capture: TrainingCapture,
    track: BodyTrack,
    generator: torch.Generator,
    background: Backdrop | None,
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
