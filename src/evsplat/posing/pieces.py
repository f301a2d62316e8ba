"""Pieces of a long recording, each corrected by itself, and their motions joined again."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, PoseErrors
from evsplat.body.rotations import nearest_axis_angle
from evsplat.capture import Frame, TrainingCapture
from evsplat.landmarks.pictures import SharpPicture, sharp_pixels

_MOST_PIXELS = 24_000_000
"""Of the pictures of one piece: with all that is computed of them 140 B a pixel."""
_FEWEST_FRAMES, _SHARED_FRAMES = 24, 8
"""Training frames of a piece at least, where there are as many, and those that neighbouring pieces
share: the ends of a piece are seen from one side only."""
_AROUND = 8
"""Keys beside a piece: a spline forgets three quarters of a value from one to the next."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Some of the frames, without a gap, and when they count."""

    frames: list[Frame]
    """In order of time, of both splits."""
    start_us: int
    end_us: int
    """The exposures' first and last time; at the ends of the recording those of the motion."""
    shrink: int
    """By how much the pictures are made smaller along each side, so that enough fit."""

    def pictures(self, all_of: Sequence[SharpPicture]) -> list[SharpPicture]:
        """Those in the exposures of its frames."""
        names = {frame.name for frame in self.frames}
        return [picture for picture in all_of if picture.frame.name in names]


def cut_in_pieces(track: BodyTrack, capture: TrainingCapture) -> list[Piece]:
    """The recording whole, or pieces of about the same length that overlap."""
    frames = sorted(capture.frames, key=lambda frame: frame.mid_us)
    trained = [number for number, frame in enumerate(frames) if frame.split == "train"]
    pixels, shrink = sharp_pixels(capture.camera(frames[0])), 1
    while _FEWEST_FRAMES * pixels > _MOST_PIXELS * shrink**2:
        shrink *= 2
    # Those held out between training frames have pictures as well.
    most = _MOST_PIXELS * shrink**2 * len(trained) // (pixels * len(frames))
    spans = _spans(len(trained), max(_FEWEST_FRAMES, most))
    found = []
    for first, last in spans:
        begins, ends = first == 0, last == len(trained) - 1
        chosen = frames[
            0 if begins else trained[first] : len(frames) if ends else trained[last] + 1
        ]
        times = [time_us for frame in chosen for time_us in frame.exposure_us]
        start_us = min(int(track.times_us[0]), *times) if begins else min(times)
        end_us = max(int(track.times_us[-1]), *times) if ends else max(times)
        found.append(Piece(chosen, start_us, end_us, shrink))
    return found


def _spans(count: int, most: int) -> list[tuple[int, int]]:
    """First and last of at most ``most`` of ``count`` things in each piece."""
    if count <= most:
        return [(0, count - 1)]
    pieces = -(-(count - _SHARED_FRAMES) // (most - _SHARED_FRAMES))
    length = -(-(count - _SHARED_FRAMES) // pieces) + _SHARED_FRAMES
    starts = [round(k * (count - length) / (pieces - 1)) for k in range(pieces)]
    return [(start, start + length - 1) for start in starts]


def between(track: BodyTrack, start_us: int, end_us: int) -> BodyTrack:
    """The motion between two times, which its keys around them hold in place."""
    first, last = np.searchsorted(track.times_us, [start_us, end_us])
    keys = slice(max(0, first - _AROUND), last + _AROUND)
    errors = track.errors
    if errors is not None:
        said = errors.joint_rad[keys], errors.root_m[keys]
        errors = PoseErrors(errors.source, *said, typical=errors.typical)
    times, poses, transl = track.times_us[keys], track.poses[keys], track.transl[keys]
    return track.with_keys(times, poses, transl, source="piece of a motion", errors=errors)


def joined(pieces: Sequence[Piece], tracks: Sequence[BodyTrack]) -> BodyTrack:
    """One motion: where two pieces overlap, from the one's to the other's evenly in time.

    ``tracks``: the motion in each of the pieces, which may reach beyond it, with its errors.
    """
    if len(tracks) == 1:
        return tracks[0]
    times = np.unique(np.concatenate([_inside(*pair) for pair in zip(pieces, tracks, strict=True)]))
    joints = len(tracks[0].body.parents)
    turns, places = np.zeros((len(times), joints, 3)), np.zeros((len(times), 3))
    joint_var, root_var = np.zeros((len(times), joints)), np.zeros((len(times), 3))
    for number, (piece, track) in enumerate(zip(pieces, tracks, strict=True)):
        at = np.flatnonzero((times >= piece.start_us) & (times <= piece.end_us))
        before = pieces[number - 1].end_us if number else piece.start_us
        share = _since(times[at], piece.start_us, before)
        rotations, transl = (each.double().numpy() for each in track.at(times[at].tolist()))
        own = Rotation.from_matrix(rotations.reshape(-1, 3, 3))
        known = Rotation.from_rotvec(turns[at].reshape(-1, 3))
        part = np.repeat(share, joints)[:, None] * (known.inv() * own).as_rotvec()
        turns[at] = (known * Rotation.from_rotvec(part)).as_rotvec().reshape(-1, joints, 3)
        places[at] += share[:, None] * (transl - places[at])
        assert track.errors is not None
        for variance, std in ((joint_var, track.errors.joint_rad), (root_var, track.errors.root_m)):
            own_var = _at(times[at], track.times_us, np.square(std))
            variance[at] += share[:, None] * (own_var - variance[at])
    errors = PoseErrors("estimated", np.sqrt(joint_var), np.sqrt(root_var))
    poses = nearest_axis_angle(turns)
    return tracks[0].with_keys(times, poses, places, source="joined motion", errors=errors)


def _inside(piece: Piece, track: BodyTrack) -> Int64[np.ndarray, "P"]:
    times = track.times_us
    return times[(times >= piece.start_us) & (times <= piece.end_us)]


def _since(times_us: np.ndarray, start_us: int, full_us: int) -> Float[np.ndarray, "P"]:
    """From 0 at one time to 1 at another, and after it."""
    if full_us <= start_us:
        return np.ones(len(times_us))
    return np.clip((times_us - start_us) / (full_us - start_us), 0.0, 1.0)


def _at(
    times_us: np.ndarray, known_us: np.ndarray, values: Float[np.ndarray, "K C"]
) -> Float[np.ndarray, "P C"]:
    """Values at other times, linear between."""
    return np.stack([np.interp(times_us, known_us, column) for column in values.T], 1)
