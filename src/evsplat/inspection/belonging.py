"""Does the posed body belong to the recording? Its outline against what moves there.

The body's silhouette is correlated with maps of events and of frame differences, over shifts in
pixels and in time. A right body fits best where it is; a misplaced or late one fits better
elsewhere; another recording's body fits a frame no better in its own pose than in other poses.
Limits are from staged captures (benchmarks/wrong_bodies.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Int

from evsplat.body import BodyTrack
from evsplat.capture import Frame, TrainingCapture, load_body_track
from evsplat.inspection.elsewhere import Elsewhere, find_elsewhere
from evsplat.inspection.figure import Coarse, Figure, grown, outlines
from evsplat.inspection.movement import MOST_FRAMES, looked_at, movement, small_pictures, stands
from evsplat.inspection.search import DELAYS, NOW, REACH_PX, BestPlace, drawn, in_picture
from evsplat.spread import evenly_spread
from evsplat.wording import counted

Verdict = Literal["belongs", "off", "another", "unknown"]

WIDENED_PX = 2
"""Clothes and hair are taken to be within so many map pixels of the bare body."""
_OFF_PX, _OFF_FRAMES = 3.5, 1.0
"""Best places so far away, map pixels or frames, are told ..."""
_LEAST_GAIN, _LEAST_GAIN_IN_TIME, _LEAST_GAIN_OF_A_FRAME = 0.025, 0.05, 0.1
"""... if so much of the correlation there is missing where the body is: for shifts, for delays
alone, and for those of less than two frames, which slow motions hardly show."""
_LEAST_GAIN_OF_CHANGE = 0.13
"""Of the correlation of what changes in time, where it tells delays (`BestPlace.changed`): the
man's own bodies lost up to 0.06, those 2 frames off 0.27 and more, and this is midway."""
_ANOTHER, _DOUBTFUL, _FOLLOWS = 0.75, 0.85, 0.9
"""Order below which a body is another one, below which it may be, and above which it is none."""
_LEAST_FOLLOWED = 0.1
"""What moves has more than this of a right body's changes in it (`OwnTimes.follows`): those of two
draws had 0.13 and more, others' bodies in the same place 0.07."""
_PARTED = 0.05
"""A doubtful one is another if halves of the recording disagree so much on the best place."""
_FAINT = 0.08
"""A correlation below it is no sign of anything."""
_APART = 1.9
"""Poses are compared that are so many frames apart, or more."""


@dataclass(frozen=True)
class Belonging:
    """How the posed body fits what moves: where it is, and where it would fit best."""

    frames: tuple[Frame, ...]
    """Frames that were looked at."""
    shares: Mapping[str, float]
    """Share of "events" and of "frames" (their differences) inside of the outline, of what there
    is; empty where nothing moves."""
    area: float
    """Share of the picture inside of the outline, which is a little widened; 0: out of view."""
    shift_px: tuple[float, float]
    """Way from the body to where it fits best, pixels of the picture, right and down."""
    tolerance_px: float
    """Shifts below it are not told."""
    delay_frames: float
    """Above zero: the body is late, by so many frames."""
    delay_us: int
    """The same in microseconds: what the body does then is seen now."""
    score: float
    """Correlation with what moves, of the body where it is."""
    best_score: float
    """The highest correlation at any shift and delay."""
    order: float | None
    """Share of pairs of times in which, at the best place, a frame's own pose fits better than the
    other time's: 1 where it always does, 0.5 by chance. None where frames are few or poses differ
    little."""
    follows: float | None
    """How much of the body's changes is in what moves, at the best place (`OwnTimes.follows`); None
    as `order`."""
    parting: float
    """Share of its correlation that the first or second half of the recording, the worse, loses at
    the common best place against the best place of its own."""
    change_lost: float | None
    """Share of the correlation of what changes in time that is lost for want of the delay, which is
    then the one at which it is highest; None where it tells nothing, or the shift does."""
    change_score: float | None
    """That correlation at the delay; None as ``change_lost``."""
    standing_camera: bool
    in_no_training_frame: bool
    """The posed body is out of view in every training frame."""
    in_no_held_out_frame: bool
    """There are held-out frames, and the posed body is out of view in all of them."""
    elsewhere: Elsewhere | None = None
    """What moves beside a body that belongs; None where the camera moves."""

    @property
    def is_odd(self) -> bool:
        """Whether there is something to be told, and to be looked at in a picture."""
        return self.verdict != "belongs" or self.elsewhere is not None

    @property
    def verdict(self) -> Verdict:
        """``off``: fits better elsewhere; ``another``: out of view, or follows nothing anywhere.

        ``unknown``: too little moves, or, with the camera, all; or it hardly follows what moves.
        """
        if self.area == 0:
            return "another"
        if not self.shares or self.best_score < _FAINT:
            return "unknown"
        if not self._is_off:
            return "unknown" if self._hardly_follows else "belongs"
        order = self.order
        if not self.standing_camera:
            return "off" if order is not None and order >= _FOLLOWS else "unknown"
        if order is None or order >= _DOUBTFUL:
            return "off"
        return "another" if order < _ANOTHER or self.parting > _PARTED else "off"

    @property
    def _is_far(self) -> bool:
        return float(np.hypot(*self.shift_px)) >= self.tolerance_px

    @property
    def _is_off(self) -> bool:
        gain, delay = 1 - self.score / self.best_score, abs(self.delay_frames)
        if self._is_far:
            return gain > _LEAST_GAIN
        if self.change_lost is not None:
            return delay >= _OFF_FRAMES and self.change_lost > _LEAST_GAIN_OF_CHANGE
        least = _LEAST_GAIN_OF_A_FRAME if delay < 2 * _OFF_FRAMES else _LEAST_GAIN_IN_TIME
        return delay >= _OFF_FRAMES and gain > least

    @property
    def _hardly_follows(self) -> bool:
        """In the right place, as somebody else in another recording may be."""
        if self.order is None or self.follows is None or not self.standing_camera:
            return False
        return self.order < _DOUBTFUL and self.follows < _LEAST_FOLLOWED

    @property
    def where(self) -> str:
        """Inside of the outline, in words and figures."""
        if self.area == 0:
            return f"the posed body is in none of the {len(self.frames)} pictures looked at"
        names = {"events": "of the events", "frames": "of what changes between frames"}
        said = [f"{share:.0%} {names[name]}" for name, share in self.shares.items()]
        moves = " and ".join(said) or "nothing that moves"
        return f"{moves} inside of its outline, {self.area:.0%} of the picture"

    @property
    def place(self) -> str:
        """Way from what moves to the body, such as "14 px right of and 2 frames behind"."""
        right, down = self.shift_px
        said = []
        if self._is_far:
            sides = (("left of", right), ("right of", -right), ("above", down), ("below", -down))
            said = [f"{px:.0f} px {side}" for side, px in sides if px >= self.tolerance_px / 2]
        if abs(self.delay_frames) >= _OFF_FRAMES:
            side = "behind" if self.delay_frames > 0 else "ahead of"
            said.append(f"{counted(abs(self.delay_frames), 'frame')} {side}")
        return " and ".join(said)

    @property
    def sentence(self) -> str:
        """The verdict in words and figures."""
        fit = f"correlation {self.score:.2f}"
        if self.best_score > self.score:
            fit += f", at best {self.best_score:.2f}"
        if self.verdict == "belongs":
            return f"the posed body fits what moves: {self.where} ({fit})"
        if self.verdict == "off":
            if not self._is_far and self.change_lost is not None and self.change_score is not None:
                # What told the delay: most of somebody who stays is the same with and without it.
                here = self.change_score * (1 - self.change_lost)
                fit = f"correlation of what changes {here:.2f}, {self.change_score:.2f}"
            return f"the posed body is {self.place} what moves: {self.where} ({fit} elsewhere)"
        if self.area == 0:
            return f"{self.where}; check camera and poses"
        if self.verdict == "another":
            return (
                f"the posed body follows nothing that moves, at no shift and delay: its own pose "
                f"fits a frame better than another time's in {self.order:.0%} of pairs (by chance "
                f"50 %, a right body's in over 90 %); {self.where} ({fit})"
            )
        if self.best_score >= _FAINT and self._hardly_follows:
            return (
                f"the posed body is where something moves but hardly follows it, as another "
                f"recording's may: {self.where} ({fit})"
            )
        why = "too little moves; check camera and exposure"
        if not self.standing_camera:
            if not self.shares:
                return (
                    "the posed body cannot be judged: the camera moves, so that its pictures do "
                    "not tell what else does, and it has no events"
                )
            why = "the camera moves, and so does all that it sees"
        return f"the posed body cannot be judged, {why}: {self.where}"


def judge_body(capture: TrainingCapture, track: BodyTrack | None = None) -> Belonging:
    """Compare the posed body with what moves in the training frames and in their events.

    ``track`` is the capture's own where it is left out. Of at most `MOST_FRAMES` frames and the
    20 ms of events about the middle of each; a second of one core, more where the camera moves.

    Raises:
        DataError: there is no training frame, or no body.
    """
    figure = Figure(load_body_track(capture) if track is None else track)
    frames = looked_at(capture)
    cameras = [capture.camera(frame) for frame in frames]
    mids_us = np.array([frame.mid_us for frame in frames])
    coarse = Coarse.of(cameras[0], float(np.median(figure.heights_px(mids_us.tolist(), cameras))))
    pictures = small_pictures(capture, frames, coarse) if stands(frames) else None
    found = movement(capture, frames, coarse, pictures)
    period_us = _period_us(capture)
    times_us, owner, row = _times(mids_us, period_us, together=stands(frames))
    posed = figure.maps(times_us, [cameras[k] for k in owner], coarse, REACH_PX)
    edges = outlines(posed)
    size = (coarse.height, coarse.width)
    now = in_picture(posed[row[:, NOW]], size, 0, 0)
    for _ in range(WIDENED_PX):
        now = grown(now)
    best = BestPlace.of(
        found,
        lambda kind, rows: drawn(kind, posed[rows], edges[rows]),
        np.abs(mids_us[:, None] - mids_us) >= _APART * period_us,
        row,
    )
    shift_px = best.right * coarse.pixel, best.down * coarse.pixel
    tolerance_px = _OFF_PX * coarse.pixel
    delay, change_lost, change_score = best.delay, None, None
    if float(np.hypot(*shift_px)) < tolerance_px and stands(frames) and best.changed is not None:
        delay, change_lost = best.changed
        assert best.changing is not None
        change_score = float(best.changing[0, delay])
    held_out = evenly_spread(capture.held_out_frames, MOST_FRAMES)
    judged = Belonging(
        frames,
        shares={name: float(maps[now].sum() / maps.sum()) for name, maps in found.items()},
        area=float(now.mean()),
        shift_px=shift_px,
        tolerance_px=tolerance_px,
        delay_frames=DELAYS[delay],
        delay_us=round(DELAYS[delay] * period_us),
        score=best.given_score,
        best_score=best.score,
        order=None if best.own_times is None else best.own_times.order,
        follows=None if best.own_times is None else best.own_times.follows,
        change_lost=change_lost,
        change_score=change_score,
        parting=best.parting,
        standing_camera=stands(frames),
        in_no_training_frame=not now.any() and _in_none(capture, figure, capture.train_frames),
        in_no_held_out_frame=_in_none(capture, figure, held_out),
    )
    if pictures is None or judged.verdict != "belongs":
        return judged
    # half a frame before and after: an exposure is hardly longer
    about = np.logical_or.reduce([posed[row[:, NOW + half]] for half in (-1, 0, 1)])
    picture_px = (cameras[0].width, cameras[0].height)
    beside = find_elsewhere(pictures, found, in_picture(about, size, 0, 0), picture_px)
    return replace(judged, elsewhere=beside)


def _in_none(capture: TrainingCapture, figure: Figure, frames: Sequence[Frame]) -> bool:
    """Whether there are frames, and the body is out of view in all."""
    mids_us, cameras = [f.mid_us for f in frames], [capture.camera(f) for f in frames]
    return len(frames) > 0 and not figure.heights_px(mids_us, cameras).any()


def _period_us(capture: TrainingCapture) -> float:
    """Median time from a frame to the next, of all of the camera; of a single one its exposure."""
    name = capture.train_frames[0].camera
    frames = [frame for frame in capture.frames if frame.camera == name]
    mids = np.unique([frame.mid_us for frame in frames])
    start, end = frames[0].exposure_us
    return float(np.median(np.diff(mids))) if len(mids) > 1 else float(end - start)


def _times(
    mids_us: Int[np.ndarray, "K"], period_us: float, *, together: bool
) -> tuple[list[int], list[int], Int[np.ndarray, "K D"]]:
    """Times of all delays of all frames, a frame that asks for each, and each frame's places there.

    ``together`` takes times of several frames as one where they are.
    """
    wanted = mids_us[:, None] + np.round(np.multiply(DELAYS, period_us)).astype(np.int64)
    grid = np.arange(wanted.size).reshape(wanted.shape)
    if together:
        # frames hardly come exactly evenly: times within a sixteenth of a period are one
        grid = np.round(wanted / max(1.0, period_us / 16)).astype(np.int64)
    _, first, row = np.unique(grid, return_index=True, return_inverse=True)
    owner = first // len(DELAYS)
    return wanted.ravel()[first].tolist(), owner.tolist(), row.reshape(wanted.shape)
