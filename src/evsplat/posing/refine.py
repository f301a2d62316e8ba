"""Analysis by synthesis: a motion corrected so that discs on the body explain the pictures.

No Gaussians are trained. The person is drawn as one-coloured discs on the surface of the body, and
what is unknown of motion and look is moved downhill until the drawings are like the sharp pictures.
"""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import Body, BodyTrack, PoseErrors
from evsplat.body.pose_noise import PoseNoise, joint_angles
from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import DataError
from evsplat.landmarks.pictures import sharp_pictures
from evsplat.posing.correction import Correction
from evsplat.posing.descent import COARSE_PX, LOOK_STEPS, PROBE_STEPS, PROBES, Descent
from evsplat.posing.pieces import between, cut_in_pieces, joined
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import (
    NobodyInViewError,
    Targets,
    find_targets,
    halved,
    refuse_no_background,
)
from evsplat.posing.time_limit import TimeLimit

DISCS, _JUDGED_DISCS = 4_000, 3_000
"""On the body; as many as `Descent` draws in pictures of `JUDGED_PX`."""
UNKNOWN_RAD, UNKNOWN_M = 0.05, 0.02
"""Errors expected of limb joints and of the root's place, per axis, where nobody says."""
LEAST_GAIN = 0.09
"""Share by which pictures kept aside must be explained better for given poses to count as wrong.
Exact poses of 49 staged captures came to 0.08 at most, 39 of 42 with an estimator's errors to more
than this."""
_LEAST_AXIS = 0.5
_STEPS = (160, 140)
FOUND_STEPS = (160, 320)
"""Of motions that landmarks found, which are off by more than what most others tell."""
_LAST_STEPS = 40
"""Steps in which pictures kept aside are explained as well, once they have judged."""
_NEARER = 0.6
"""How near to the corrected body the background is taken for sure, in shares of before."""


JUDGED_PX, JUDGED_FRAMES = 128, 24
"""Least side of the pictures, and training frames, that tell whether given poses are exact. More
of either takes the longer and tells no more: `LEAST_GAIN` was chosen on recordings of this size."""


@dataclass(frozen=True, eq=False)
class Gain:
    """Whether a corrected motion is better than the given one."""

    gain: float
    """Share by which it explains pictures better that neither motion was fitted to."""
    gain_error: float
    """Standard error of the gain over the frames."""
    seconds: float

    @property
    def better(self) -> bool:
        """True where the gain exceeds 0 by two standard errors: these err less than given ones."""
        return self.gain - 2 * self.gain_error > 0


@dataclass(frozen=True, eq=False)
class Verdict(Gain):
    """Of a motion that doesn't say how far it errs."""

    coarse_gain: float
    """The gain in pictures of half the size; as ``gain`` where no larger ones were asked."""
    given_errors: PoseErrors
    """Errors of the given motion, by how far the corrected one lies from it."""

    @property
    def disproves(self) -> bool:
        """True where the given poses count as wrong: `better`, by more than `LEAST_GAIN`.

        Less what it was larger by in smaller pictures. What discs cannot show of a person moves a
        true motion the more, the smaller the pictures are; errors are seen in any size.
        """
        exaggerated = max(0.0, self.coarse_gain - self.gain)
        return self.better and self.gain - exaggerated > LEAST_GAIN


@dataclass(frozen=True, eq=False)
class Refined(Gain):
    """A corrected motion, and whether it is better than the given one."""

    track: BodyTrack
    """The corrected motion with its errors; `better` says whether to use it."""
    dressed: Body
    """The body with its surface where pictures show the person's: clothes, hair and shoes too."""


def judge(
    track: BodyTrack,
    capture: TrainingCapture,
    *,
    progress: bool = False,
    steps: tuple[int, int] = _STEPS,
    discs: int = _JUDGED_DISCS,
) -> Verdict:
    """Compare a motion with one that is corrected, in a piece of the recording and small pictures.

    Of motions that don't say how far they err: what `refine` finds out on its way as well, but in
    a time that grows neither with the recording nor with its pictures. Where the smallest pictures
    say for certain that the gain is below `LEAST_GAIN`, no larger ones are asked: what discs cannot
    show moves a true motion the more, the smaller the pictures are.

    Raises:
        DataError: the camera moves, or the posed body is in no picture.
    """
    began = time.monotonic()
    refuse_no_background(capture)
    frames = _middle(capture)
    times = [time_us for frame in frames for time_us in frame.exposure_us]
    shrink = halved(capture.camera(frames[0]), JUDGED_PX)
    pictures = sharp_pictures(capture, frames=frames)
    targets = find_targets(track, capture, pictures, shrink=shrink)
    piece = between(track, min(times), max(times))
    with closing(TimeLimit(None, 5 * LOOK_STEPS + sum(steps), progress=progress)) as limit:
        found = _descended(piece, targets, limit, steps, discs, least_gain=LEAST_GAIN)
    errors = _given_errors(found.descent.correction, len(track.times_us))
    gain, coarse_gain = _mean_gain(found.better), _mean_gain(found.coarse)[0]
    return Verdict(*gain, time.monotonic() - began, coarse_gain, errors)


def refine(
    track: BodyTrack,
    capture: TrainingCapture,
    *,
    seconds: float | None = None,
    progress: bool = False,
    steps: tuple[int, int] = _STEPS,
    discs: int = DISCS,
) -> Refined:
    """Correct a motion by the sharp pictures of a capture.

    Pictures in the middle of exposures are kept aside for the `gain`. Where the policy shows events
    of held-out frames, pictures carried there by events count as well. ``steps``: of the coarse
    and of the fine part, fewer where they would take more than ``seconds``.

    Of a long recording each piece is corrected by itself, but for those without the person.

    Raises:
        DataError: the camera moves, or the posed body is in no picture.
    """
    began = time.monotonic()
    refuse_no_background(capture)
    pieces = cut_in_pieces(track, capture)
    planned = 3 * LOOK_STEPS + sum(steps) + _LAST_STEPS + PROBES * PROBE_STEPS
    found, missed = [], None
    with closing(TimeLimit(seconds, len(pieces) * planned, progress=progress)) as limit:
        pictures = sharp_pictures(capture)
        for piece in pieces:
            given = between(track, piece.start_us, piece.end_us)
            own = piece.pictures(pictures)
            try:
                targets = find_targets(given, capture, own, shrink=piece.shrink)
            except NobodyInViewError as error:
                missed = error
                found.append(_Piece(torch.empty(0), _with_errors(given), None))
                continue
            found.append(_finished(_descended(given, targets, limit, steps, discs)))
    bodies = [one.dressed for one in found if one.dressed is not None]
    if missed is not None and not bodies:
        raise missed
    return Refined(
        *_mean_gain(torch.cat([one.better for one in found])),
        time.monotonic() - began,
        joined(pieces, [one.track for one in found]),
        _mean_body(bodies),
    )


@dataclass(frozen=True, eq=False)
class _Piece:
    """What pictures make of one piece of a motion."""

    better: Float[Tensor, "A"]
    """See `_gain`."""
    track: BodyTrack
    dressed: Body | None
    """None where the person is out of view, and the motion stays as it is given."""


def _finished(found: "_Descended") -> _Piece:
    """With the last steps, in which pictures kept aside are explained as well."""
    descent = found.descent
    descent.targets = found.nearer
    descent.run(1, _LAST_STEPS, first=False)
    corrected = descent.correction.corrected(descent.errors())
    return _Piece(found.better, corrected, descent.look.dressed())


def _with_errors(track: BodyTrack) -> BodyTrack:
    """A motion that is left as it is; what it errs by as expected, where it does not say."""
    if track.errors is not None:
        return track
    joint_rad, root_m = (np.tile(each, (len(track.times_us), 1)) for each in expected_errors(track))
    return track.with_errors(PoseErrors("estimated", joint_rad, root_m))


def _mean_body(bodies: Sequence[Body]) -> Body:
    """The mean surface of bodies with the same joints."""
    first, *others = bodies
    if not others:
        return first
    vertices = torch.stack([body.rest_vertices for body in bodies]).mean(0)
    return replace(first, rest_vertices=vertices)


def _middle(capture: TrainingCapture) -> list[Frame]:
    """The frames from the first to the last of `JUDGED_FRAMES` training frames in the middle."""
    trained = sorted(frame.mid_us for frame in capture.train_frames)
    first = max(0, len(trained) - JUDGED_FRAMES) // 2
    kept = trained[first : first + JUDGED_FRAMES]
    return [frame for frame in capture.frames if kept[0] <= frame.mid_us <= kept[-1]]


@dataclass(frozen=True, eq=False)
class _Descended:
    """A motion as pictures correct it, those in the middle of exposures kept aside."""

    descent: Descent
    nearer: Targets
    """All pictures, and what is behind the person by the motion found in the smallest ones."""
    better: Float[Tensor, "A"]
    """See `_gain`."""
    coarse: Float[Tensor, "A"]
    """The same in the smallest pictures, where a ``least_gain`` was asked; else as ``better``."""


def _descended(
    track: BodyTrack,
    targets: Targets,
    limit: TimeLimit,
    steps: tuple[int, int],
    discs: int,
    *,
    least_gain: float | None = None,
) -> _Descended:
    """Ends after the smallest pictures where these say that the gain is below ``least_gain``."""
    correction = Correction(track, *expected_errors(track))
    look = SurfaceDiscs(track.body, discs, torch.Generator().manual_seed(0))
    aside = _middles(targets)
    fitted = sorted(set(range(len(targets.times_us))) - set(aside)) or aside
    descent = Descent(correction, look, targets.rows(fitted), limit)
    nearer = targets
    coarse = None
    for number, (shrink, count) in enumerate(_sizes(targets.camera, steps)):
        descent.run(shrink, count, first=number == 0)
        if number > 0:
            continue
        if least_gain is not None:
            coarse = _gain(descent, targets.rows(aside), shrink)
            gain, gain_error = _mean_gain(coarse)
            if gain + 2 * gain_error < least_gain:
                return _Descended(descent, nearer, coarse, coarse)
        nearer = targets.around(correction.corrected(), _NEARER)
        descent.targets = nearer.rows(fitted)
    better = _gain(descent, targets.rows(aside))
    return _Descended(descent, nearer, better, better if coarse is None else coarse)


def _sizes(camera: Camera, steps: tuple[int, int]) -> list[tuple[int, int]]:
    """By how much pictures are made smaller, and steps at each size: fewer in larger ones."""
    shrink = halved(camera, COARSE_PX)
    finer = [1 << k for k in reversed(range(shrink.bit_length() - 1))] or [1]
    share = steps[1] / sum(finer)
    return [(shrink, steps[0]), *((size, max(1, round(share * size))) for size in finer)]


def expected_errors(track: BodyTrack) -> tuple[Float[np.ndarray, "J"], Float[np.ndarray, "3"]]:
    """What joints (radians) and root (metres) are expected to err by, per axis, root mean square.

    Where the track does not say, limbs by more than the trunk.
    """
    errors = track.errors
    if errors is not None and not errors.typical and errors.joint_rad.any():
        size = np.sqrt(np.square(errors.joint_rad).mean(0))
        return size, np.sqrt(np.square(errors.root_m).mean(0))
    return _anatomical(track.body), np.full(3, UNKNOWN_M)


@torch.no_grad()
def _given_errors(correction: Correction, keys: int) -> PoseErrors:
    """Errors of the motion that was corrected, root mean squares of the correction, at all keys.

    Of the joints one factor on what was expected of each: the correction of a single joint may be
    another's, turned the other way. Of the root at least `_LEAST_AXIS` of its worst axis.
    """
    track = correction.track
    weights = correction.weights(track.times_us.tolist())
    turned = torch.einsum("tm,mjc->tjc", weights, correction.turns).square().mean().sqrt()
    joint_rad = np.zeros((keys, track.poses.shape[1]))
    joint_rad[:, correction.joints.numpy()] = float(turned) * correction.joint_rad.numpy()
    moved = (correction.root_m * (weights @ correction.shifts)).square().mean(0).sqrt()
    root_m = moved.clamp_min(_LEAST_AXIS * float(moved.max())).double().numpy()
    return PoseErrors("estimated", joint_rad, np.tile(root_m, (keys, 1)))


def _anatomical(body: Body) -> Float[np.ndarray, "J"]:
    noise = PoseNoise(UNKNOWN_RAD, UNKNOWN_RAD / 2, UNKNOWN_M, UNKNOWN_M)
    try:
        return joint_angles(body, noise)
    except DataError:  # a skeleton without names
        return np.full(len(body.parents), UNKNOWN_RAD)


def _middles(targets: Targets) -> list[int]:
    """Pictures of training frames that are nearest to the middle of each one's exposure."""
    best: dict[str, tuple[int, int]] = {}
    for number, (at, frame) in enumerate(zip(targets.times_us, targets.frames, strict=True)):
        if frame.split == "train":
            best[frame.name] = min(
                best.get(frame.name, (1 << 62, 0)), (abs(at - frame.mid_us), number)
            )
    return [number for _, number in best.values()]


def _gain(descent: Descent, aside: Targets, shrink: int = 1) -> Float[Tensor, "A"]:
    """How much better the corrected motion explains each of the pictures kept aside.

    As logarithms of the ratio of both misfits.

    Both motions get their look learned for as many steps from where the corrected one's was, in
    pictures smaller by a factor.
    """
    targets = descent.targets
    if shrink > 1:
        targets, aside = targets.smaller(shrink), aside.smaller(shrink)
    params = [descent.correction.turns, descent.correction.shifts]
    found = [param.detach().clone() for param in params]
    state = {name: value.clone() for name, value in descent.look.state_dict().items()}
    misfits = []
    for factor in (1.0, 0.0):
        with torch.no_grad():
            for param, value in zip(params, found, strict=True):
                param.copy_(factor * value)
        descent.look.load_state_dict(state)
        descent.learn_look(targets, shrink, LOOK_STEPS)
        misfits.append(descent.misfits(aside))
    with torch.no_grad():
        for param, value in zip(params, found, strict=True):
            param.copy_(value)
    descent.look.load_state_dict(state)
    return (misfits[1] / misfits[0]).log()


def _mean_gain(better: Float[Tensor, "A"]) -> tuple[float, float]:
    """Of values of `_gain`, the share that they are in the mean, and its standard error."""
    spread = float(better.std()) if len(better) > 1 else math.inf
    return 1 - math.exp(-float(better.mean())), spread / math.sqrt(len(better))
