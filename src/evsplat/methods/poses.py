"""Noisy body poses: how noisy they are, what is smoothed, and what training may correct."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from evsplat.body import BodyTrack
from evsplat.body.smoothing import MotionNoise, SplineError, motion_noise, smoothed, spline_error
from evsplat.capture import TrainingCapture, load_body_track
from evsplat.config import Above, ReadIf
from evsplat.errors import ConfigError
from evsplat.methods.settings import WITH_EVENTS, WITH_WINDOWS, Nominal, NotNegative, Weight
from evsplat.models.pose_spline import PoseSpline

logger = logging.getLogger(__name__)

When = Literal["auto", "always", "never"]
"""``auto``: where the key poses are noisy, see `PoseSettings.noisy_rad`."""
EXACT_RAD = 1e-3
"""Poses that jitter by less are taken as exact, whatever the motion."""
LEAST_STD_RAD, LEAST_STD_M = 0.02, 0.01
"""Expected errors of noisy poses, however little they jitter: what was fitted to pictures errs by
more, and that changes slowly."""

_NOT_ALWAYS = ReadIf("pose.refine", "auto or never", lambda refine: refine != "always")
_REFINED = ReadIf("pose.refine", "auto or always", lambda refine: refine != "never")


@dataclass(frozen=True)
class PoseSettings:
    """Errors of the given poses."""

    smooth: When
    """Take out of the given key poses what looks like noise."""
    refine: When
    """Learn a residual of the poses, a cubic B-spline in time, from pictures and events."""
    between: Annotated[bool, _NOT_ALWAYS]
    """Where poses are taken as exact, learn how the person moves between them: such a residual that
    is zero at every key pose."""
    noisy_rad: NotNegative
    """Jitter of key poses, radians per axis, from which poses count as noisy. With less they do if
    its variance is half or more of what a spline through the poses misses between them."""
    start: Nominal
    """Nominal iteration from which the residual is learned."""
    prior: Weight
    """Weight of the residual's mean square in units of the errors expected."""
    std_rad: Annotated[float, Above(0), _REFINED] | None
    """Error expected of a joint, radians per axis; null = the jitter, at least 0.02."""
    std_m: Annotated[float, Above(0), _REFINED] | None
    """Error expected of the root's place, metres per axis; null = its jitter, at least 0.01."""
    events_of_held_out: Annotated[bool, WITH_EVENTS, WITH_WINDOWS]
    """Let events around held-out frames correct the poses there; needs
    ``policy.held_out_events``. The pictures of those frames stay unseen and nothing else is learned
    there."""


@dataclass(frozen=True)
class Poses:
    """Motion of a model."""

    track: BodyTrack
    spline: PoseSpline | None = None
    """None where nothing is to be learned of poses."""
    priced_us: Sequence[int] = ()
    """Times at which the residual costs."""


def prepare_poses(config: PoseSettings, capture: TrainingCapture, *, announce: bool) -> Poses:
    """Track of a capture by the settings, and the residual to learn; said at level INFO on wish."""
    track = load_body_track(capture)
    noise, expected = motion_noise(track), spline_error(track)
    surer = _surer_than_between(noise, expected)
    noisy = noise.rotation_rad >= (config.noisy_rad if surer else EXACT_RAD)
    smooth, refine = (
        noisy if when == "auto" else when == "always" for when in (config.smooth, config.refine)
    )
    for name in ("std_rad", "std_m") if not refine else ():
        if (value := getattr(config, name)) is not None:
            raise ConfigError(
                f"pose.{name} is {value}, and nothing reads it: the poses of {capture.path} are "
                "taken as exact; pass --set pose.refine=always as well, or leave it out."
            )
    between = config.between and not refine and surer
    logger.log(
        logging.INFO if announce else logging.DEBUG,
        "given poses jitter by %.4f rad per axis and are %s: %s, %s",
        noise.rotation_rad,
        "noisy" if noisy else "taken as exact",
        "smoothed in time" if smooth else "taken as they are",
        "corrected in training"
        if refine
        else "corrected between keys only"
        if between
        else "not corrected",
    )
    if smooth:
        track = smoothed(track, noise)
    times = track.times_us
    if between:
        middles = (times[1:] + times[:-1]) // 2
        return Poses(track, PoseSpline.between_keys(track, expected), middles.tolist())
    if not refine:
        return Poses(track)
    spline = PoseSpline.of(
        track,
        noise,
        [frame.mid_us for frame in capture.train_frames],
        knot_frames=1.0,
        joint_rad=config.std_rad or max(noise.rotation_rad, LEAST_STD_RAD),
        root_m=config.std_m or max(noise.translation_m, LEAST_STD_M),
        stiff=smooth,
    )
    return Poses(track, spline, times.tolist())


def _surer_than_between(noise: MotionNoise, expected: SplineError) -> bool:
    """Whether key poses err by less than half of the variance of what lies between them.

    Where they do not, either is as likely an error of fitting, and a residual that is held at the
    keys would bend to make up for them.
    """
    between = np.square(expected.rotation_rad[noise.moving])
    return len(between) > 0 and 2 * noise.rotation_rad**2 < float(between.mean())
