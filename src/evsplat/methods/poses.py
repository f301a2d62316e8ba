"""Errors of given body poses: whether there are any, what is smoothed, what training corrects."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from evsplat.body import BodyTrack, PoseErrors, PoseSource
from evsplat.body.smoothing import motion_noise, moving_joints, smoothed
from evsplat.body.spline_error import spline_error
from evsplat.capture import TrainingCapture, load_body_track
from evsplat.errors import ConfigError, DataError
from evsplat.landmarks.pictures import sharp_pixels
from evsplat.methods.settings import WITH_EVENTS, WITH_WINDOWS, Nominal, Weight
from evsplat.models.pose_correction import SHARES, PoseCorrection
from evsplat.posing.refine import Gain, Refined, Verdict, judge, refine
from evsplat.ranges import Above, ReadIf

logger = logging.getLogger(__name__)

When = Literal["auto", "always", "never"]
"""``auto``: by what the capture says of its poses, see `PoseSettings`."""
UNKNOWN = (0.05, 0.02)
"""Errors expected of joints (radians) and of the root's place (metres), per axis, of poses whose
source is unknown, and of those that are said to be exact where they are to be corrected."""
SMOOTHED_PLACE = 0.5
"""Noise that is believed of the root's place by its curve alone, over what is expected to be new in
every key along its worst axis: fast motion looks like noise as well. Across the view, where it is
seen, that is more than is new, which takes some of the slow errors out too. Of joints all that is
new in each is believed."""
SMOOTHED_ALIKE = 0.5
"""Noise that is believed of every joint alike where poses say nothing of their errors, over what is
expected to be new in the worst: how errors divide between joints is known of estimators only."""

MOST_PIXELS = 100_000_000
"""Of the pictures by which poses are corrected before training: some ten minutes of one core."""

_REFINED = ReadIf("pose.refine", "auto or always", lambda refine: refine != "never")


@dataclass(frozen=True)
class PoseSettings:
    """Errors of the given poses."""

    smooth: When
    """Take out of the given key poses what looks like noise, of each joint up to what is expected
    to be new in every pose. ``auto``: where the capture says how far its poses err."""
    refine: When
    """Learn the errors of the poses from pictures and events. ``auto``: where the capture says that
    they err, and where it doesn't say, if pictures are explained better by others."""
    between: bool
    """Learn how the person moves between the key poses: a residual that is zero at each of them.
    The less, the more of what a spline misses between them is explained by their errors."""
    start: Nominal
    """Nominal iteration from which the residual is learned."""
    prior: Weight
    """Weight of the residual's mean square in units of the errors expected."""
    std_rad: Annotated[float, Above(0), _REFINED] | None
    """Error expected of a joint, radians per axis; null = as the capture says, or by the source of
    its poses."""
    std_m: Annotated[float, Above(0), _REFINED] | None
    """Error expected of the root's place, metres per axis; null = the same."""
    events_of_held_out: Annotated[bool, WITH_EVENTS, WITH_WINDOWS]
    """Let events around held-out frames correct the poses there; needs
    ``policy.held_out_events``. The pictures of those frames stay unseen and nothing else is learned
    there."""


@dataclass(frozen=True)
class Poses:
    """Motion of a model."""

    track: BodyTrack
    correction: PoseCorrection | None = None
    """None where nothing is to be learned of poses."""
    may_err: bool = False
    """Whether they are not said to be exact; `PoseCorrection.exact` is what is held of them."""
    pace: float = 1.0
    """Factor on the learning rate of the errors. A step of Adam is a share of the error expected,
    and an error of ten degrees has to be found as exactly as one of one: with such steps poses that
    were found from the video ended farther off than they began."""


def prepare_poses(config: PoseSettings, capture: TrainingCapture, *, fit: bool) -> Poses:
    """Track of a capture by the settings, and the residual to learn.

    ``fit``: find out what the capture does not say; otherwise a state that is loaded says it.
    """
    track = load_body_track(capture)
    between = spline_error(track) if config.between else None
    source = None if track.errors is None else track.errors.source
    exact = {"always": False, "never": True}.get(config.refine)
    if exact is None and source is not None:
        exact = source == "exact"
    joint_rad, root_m = _expected(config, track)
    told = track.errors is not None and not track.errors.typical and source != "exact"
    # Errors that are found from pictures are small, and a run that goes on doesn't know them yet.
    pace = _pace(joint_rad) if told or config.std_rad is not None else 1.0
    smooth = config.smooth == "always" or (config.smooth == "auto" and told)
    if smooth:
        track = smoothed_by_expected(track, joint_rad, root_m)
    # Poses that were corrected when they were found need not wait for the same again.
    tried = source is not None and capture.poses_refined
    found: Gain | None = None
    if fit and exact is not True and not tried:
        found = _corrected(track, capture) if told else _compared(judge, track, capture)
    disproved = isinstance(found, Verdict) and found.disproves
    decided = exact if exact is not None else not disproved
    if exact is not False and decided and fit:
        _refuse_unread(config, capture)
    given = track
    if isinstance(found, Verdict) and found.better and not decided:
        track = _as_far_off(track, found.given_errors, smooth=config.smooth == "auto")
        found = _corrected(track, capture)
        joint_rad, root_m = _expected(config, track)
    if fit:
        smooth = smooth or track is not given and config.smooth == "auto"
        _announce(config, source, joint_rad, root_m, exact=decided, smooth=smooth)
    if exact and between is None:
        return Poses(given)
    frames_us = [frame.mid_us for frame in capture.train_frames]
    correction = PoseCorrection(
        given, frames_us, joint_rad=joint_rad, root_m=root_m, between=between, exact=decided
    )
    if isinstance(found, Refined) and found.better and not decided:
        if track is not given:
            correction.smooth_to(given, track)
        correction.start_at(track, found.track)
    return Poses(given, correction, exact is not True, pace)


def _pace(joint_rad: np.ndarray) -> float:
    """1 up to the errors of poses of which nobody says how far they err; of larger ones less."""
    moving = joint_rad[joint_rad > 0]
    return min(1.0, UNKNOWN[0] / float(np.sqrt(np.square(moving).mean()))) if moving.size else 1.0


def smoothed_by_expected(
    track: BodyTrack,
    joint_rad: Float[np.ndarray, "P J"],
    root_m: Float[np.ndarray, "P 3"],
    *,
    of_joints: float = 1.0,
    of_place: float = SMOOTHED_PLACE,
) -> BodyTrack:
    """Without the noise that is new in every pose, of each joint up to what is expected there.

    ``joint_rad`` (radians) and ``root_m`` (metres) are errors expected per axis; the shares of them
    that are new in every pose are believed, times ``of_joints`` and ``of_place``.
    """
    new = SHARES["fast"] ** 0.5
    most_rad = of_joints * new * np.sqrt(np.square(joint_rad).mean(0))
    return smoothed(track, motion_noise(track, most_rad, of_place * new * float(root_m.max())))


def _as_far_off(track: BodyTrack, errors: PoseErrors, *, smooth: bool) -> BodyTrack:
    """The motion as one that says how far it errs, smoothed as one whose joints err alike."""
    told = track.with_errors(errors)
    if not smooth:
        return told
    alike = np.full_like(errors.joint_rad, SMOOTHED_ALIKE * errors.joint_rad.max())
    return smoothed_by_expected(told, alike, errors.root_m)


def _corrected(track: BodyTrack, capture: TrainingCapture) -> Gain | None:
    """Poses corrected by the whole recording; None where that is ruled out, which is logged."""
    frames = capture.train_frames
    most = MOST_PIXELS // sharp_pixels(capture.camera(frames[0]))
    if len(frames) > most:
        logger.warning(
            "%s: has %d training frames, more than the %d of this size whose poses are corrected "
            "before training, since that would take long; what they err by is learned in training "
            "alone, which is less exact. Cut the recording into shorter ones where that matters.",
            capture.path, len(frames), most,
        )  # fmt: skip
        return None
    return _compared(refine, track, capture)


def _compared(how: Callable[..., Gain], track: BodyTrack, capture: TrainingCapture) -> Gain | None:
    """Other poses, found without any Gaussian; None where a moving camera rules them out."""
    try:
        found = how(track, capture, progress=True)
    except DataError as error:
        logger.info("given poses are not compared with others: %s", error)
        return None
    logger.info(
        "other poses explain the pictures %.0f +- %.0f %% better than the given ones (%.0f s)",
        100 * found.gain,
        100 * found.gain_error,
        found.seconds,
    )
    return found


def _expected(config: PoseSettings, track: BodyTrack) -> tuple[np.ndarray, np.ndarray]:
    """Errors expected of the key poses: joints (P, J), radians, and root (P, 3), metres."""
    errors = track.errors
    if errors is None or errors.source == "exact":
        keys, joints = track.poses.shape[:2]
        joint_rad, root_m = np.full((keys, joints), UNKNOWN[0]), np.full((keys, 3), UNKNOWN[1])
    else:
        joint_rad, root_m = errors.joint_rad.copy(), errors.root_m.copy()
    if config.std_rad is not None:
        joint_rad[:] = config.std_rad
    if config.std_m is not None:
        root_m[:] = config.std_m
    joint_rad[:, ~moving_joints(track)] = 0
    return joint_rad, root_m


def _announce(
    config: PoseSettings,
    source: PoseSource | None,
    joint_rad: np.ndarray,
    root_m: np.ndarray,
    *,
    exact: bool,
    smooth: bool,
) -> None:
    """Say what is held of the poses, and what is done about it."""
    taken = "exact"
    if not exact:
        moving = joint_rad[joint_rad > 0]
        radians, metres = (np.median(each) if each.size else 0.0 for each in (moving, root_m))
        taken = f"off by some {radians:.3f} rad and {1000 * metres:.0f} mm per axis"
    done = "corrected in training"
    if exact:
        done = "corrected between keys only" if config.between else "not corrected"
    logger.info(
        "given poses (source: %s) are taken as %s: %s, %s",
        source or "not said",
        taken,
        "smoothed in time" if smooth else "not smoothed",
        done,
    )


def _refuse_unread(config: PoseSettings, capture: TrainingCapture) -> None:
    for name in ("std_rad", "std_m"):
        if (value := getattr(config, name)) is not None:
            raise ConfigError(
                f"pose.{name} is {value}, and nothing reads it: the poses of {capture.path} are "
                "taken as exact; pass --set pose.refine=always as well, or leave it out."
            )
